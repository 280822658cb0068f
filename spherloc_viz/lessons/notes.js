// The teacher's notes: they follow the lesson's page, which is another window, and drive it.
(() => {
  const channel = new BroadcastChannel(`spherloc${location.pathname.replace(/\/notes$/, "")}`);
  const rows = [...document.querySelectorAll("[data-place]")], clock = document.querySelector(".clock");
  let begun = Date.now();

  channel.onmessage = ({ data }) => {
    if (typeof data !== "object") return;
    const now = rows[data.place];
    for (const row of rows) row.classList.toggle("now", row === now);
    now.classList.toggle("answered", data.answered);
    now.scrollIntoView({ block: "nearest" });
    document.querySelector(".where").textContent = `${data.place + 1} of ${rows.length}`;
    const votes = now.querySelector(".votes");
    if (votes) votes.textContent = data.votes.some((count) => count) ? `votes: ${data.votes.join(", ")}` : "";
    for (const place of now.querySelectorAll("[data-number]"))
      if (data.numbers?.[place.dataset.number]) place.textContent = data.numbers[place.dataset.number];
  };
  channel.postMessage("hello");
  addEventListener("pagehide", () => channel.postMessage("bye"));

  setInterval(() => {
    const seconds = Math.floor((Date.now() - begun) / 1000), now = document.querySelector(".now");
    clock.textContent = `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
    clock.classList.toggle("late", Boolean(now) && seconds > 60 * Number(now.dataset.ends));
  }, 500);

  addEventListener("click", ({ target }) => {
    const press = target instanceof Element ? target.closest("[data-press]")?.dataset.press : null;
    if (press === "restart") begun = Date.now();
    else if (press) channel.postMessage(press);
  });

  addEventListener("keydown", (event) => {
    const moves = { PageDown: "down", ArrowRight: "down", PageUp: "up", ArrowLeft: "up" };
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in moves)) return;
    channel.postMessage(moves[event.key]);
    event.preventDefault();
  });
})();
