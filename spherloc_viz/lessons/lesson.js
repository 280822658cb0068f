// Has the scene beside a lesson show the moment that is read. What draws the scene is in live.js or recorded.js.
(() => {
  const MANY = ["set", "option"], OPENING_MS = 90000;
  const prose = document.querySelector(".prose"), scene = openScene((numbers) => write(numbers));
  const moments = [...document.querySelectorAll("section")], where = document.querySelector(".where");
  // What the reader changed, by moment: the link or answer of the last press, and the controls moved since.
  const followed = new Map(), moved = new Map();
  const light = matchMedia("(prefers-color-scheme: light)");
  let now = null, wanted = "", channel = null;

  // Values of a state by key; of those that may be said several times by key and name.
  function parts(state) {
    return new Map([...new URLSearchParams(state)].map(([key, value]) =>
      [MANY.includes(key) ? `${key}.${value.split("=")[0]}` : key, value]));
  }

  function text(all) {
    const said = [...all].filter(([, value]) => value && !value.endsWith("="));
    return new URLSearchParams(said.map(([key, value]) => [key.split(".")[0], value])).toString();
  }

  const changed = (state, more) => text(new Map([...parts(state), ...parts(more)]));

  function stateOf(moment) {
    const hidden = moment.dataset.before && !moment.classList.contains("answered");
    const base = hidden ? moment.dataset.before : moment.dataset.state;
    const state = changed(changed(base, followed.get(moment) ?? ""), moved.get(moment) ?? "");
    return light.matches ? changed(state, "theme=light") : state;
  }

  function go() {
    wanted = stateOf(now);
    document.body.classList.add("waiting");
    const open = now.querySelector(".open a");
    if (open) open.href = `/#${wanted}`;
    for (const control of now.querySelectorAll("[data-key]")) {
      const value = parts(wanted).get(control.dataset.key);
      if (value === undefined) continue;
      control.value = control.dataset.key.includes(".") ? value.slice(value.indexOf("=") + 1) : value;
      tellValue(control);
    }
    scene.show(wanted);
  }

  function tellValue(control) {
    if (control.type !== "range") return;
    const percent = "percent" in control.dataset;
    control.nextElementSibling.textContent = percent ? `${Math.round(100 * control.value)} %` : control.value;
  }

  // A link says a state whatever link was pressed before, as in an exported lesson; controls it does not speak of stay.
  function follow(moment, more) {
    const said = parts(more), kept = [...parts(moved.get(moment) ?? "")].filter(([key]) => !said.has(key));
    followed.set(moment, more);
    moved.set(moment, text(kept));
    see(moment);
  }

  function move(moment, more) {
    moved.set(moment, changed(moved.get(moment) ?? "", more));
    see(moment);
  }

  function see(moment) {
    if (moment !== now) enter(moment);
    go();
  }

  function enter(moment) {
    now?.classList.remove("now");
    now = moment;
    now.classList.add("now");
    const place = moments.indexOf(now);
    where.textContent = `${place + 1} of ${moments.length}: ${now.querySelector("h2").textContent}`;
    history.replaceState(null, "", `#m${place}`);
    report();  // the notes do not wait for the run's numbers
    go();
  }

  // The moment that is read is the last one that begins in the upper part of the text.
  function look() {
    const box = prose.getBoundingClientRect(), line = box.top + 0.4 * box.height;
    const atEnd = prose.scrollTop + prose.clientHeight >= prose.scrollHeight - 2;
    const begun = moments.filter((one) => one.getBoundingClientRect().top <= line);
    const found = atEnd ? moments.at(-1) : (begun.at(-1) ?? moments[0]);
    if (found !== now) enter(found);
  }

  function step(by) {
    const next = moments[Math.min(Math.max(moments.indexOf(now) + by, 0), moments.length - 1)];
    next.scrollIntoView({ block: "start" });
    next.focus({ preventScroll: true });
  }

  function write(numbers) {
    for (const place of now.querySelectorAll("[data-number]"))
      place.textContent = numbers[place.dataset.number] ?? "–";
    document.body.classList.remove("waiting", "opening");
    report(numbers);
  }

  // Answers. With the teacher's view on, a press counts a vote, and the answer is shown when the class has voted.
  function answer(item) {
    const moment = item.closest("section");
    item.classList.add("told");
    item.querySelector("button").setAttribute("aria-expanded", "true");
    moment.classList.add("answered");
    followed.set(moment, item.dataset.go ?? "");
    moved.delete(moment);
    see(moment);
    report();
  }

  function vote(item) {
    const count = item.querySelector(".votes");
    count.textContent = String(Number(count.textContent) + 1);
    report();
  }

  const right = () => now.querySelector(".answers .right");

  // The teacher's notes, in a window that the class does not see (notes.js).
  function openNotes() {
    document.body.classList.remove("teacher");
    if (!channel) {
      channel = new BroadcastChannel(`spherloc${location.pathname}`);
      channel.onmessage = ({ data }) => {
        if (data === "hello" || data === "bye") document.body.classList.toggle("voting", data === "hello");
        if (data === "hello") report();
        else if (data === "reveal" && right()) answer(right());
        else if (data.startsWith("go:")) step(Number(data.slice(3)) - moments.indexOf(now));
        else if (data === "up" || data === "down") press(data);
      };
    }
    open(`${location.pathname}/notes`, "spherloc-notes", "width=720,height=900");
  }

  function report(numbers) {
    const votes = [...now.querySelectorAll(".answers li")].map((item) => Number(item.querySelector(".votes").textContent));
    channel?.postMessage({ place: moments.indexOf(now), votes, answered: now.classList.contains("answered"), numbers });
  }

  // An exported lesson has no playground and no second window, and no buttons for them.
  const live = (name) => document.querySelector(`[data-press=${name}]`);

  function press(name, button) {
    if (name === "up" || name === "down") return step(name === "up" ? -1 : 1);
    if (name === "notes") return openNotes();
    const on = document.body.classList.toggle(name);
    (button ?? document.querySelector(`[data-press=${name}]`)).setAttribute("aria-pressed", String(on));
    now.scrollIntoView({ block: "start" });
  }

  addEventListener("click", (event) => {
    if (!(event.target instanceof Element)) return;
    const link = event.target.closest("[data-change]"), item = event.target.closest(".answers li > button")?.parentElement;
    const button = event.target.closest("[data-press]");
    if (link) {
      event.preventDefault();
      follow(link.closest("section") ?? now, link.dataset.change);
    } else if (item) {
      const unanswered = !item.closest("section").classList.contains("answered");
      const counting = ["teacher", "voting"].some((name) => document.body.classList.contains(name));
      if (counting && unanswered) vote(item);
      else answer(item);
    } else if (event.target.closest(".reveal")) answer(event.target.closest(".question").querySelector(".right"));
    else if (button) press(button.dataset.press, button);
  });

  addEventListener("input", ({ target }) => {
    const key = target.dataset?.key;
    if (!key) return;
    const [many, name] = key.split(".");
    const more = new URLSearchParams([[many, name ? `${name}=${target.value}` : target.value]]);
    move(target.closest("section"), more.toString());
  });

  addEventListener("keydown", (event) => {
    // A remote control has the keys Page Up and Page Down only; the arrows are the slider's that has the focus.
    const control = event.target instanceof Element && event.target.closest("input,select");
    if ((control && !event.key.startsWith("Page")) || event.ctrlKey || event.metaKey || event.altKey) return;
    const moves = { PageDown: 1, ArrowRight: 1, PageUp: -1, ArrowLeft: -1 };
    if (event.key in moves) step(moves[event.key]);
    else if (event.key.toLowerCase() === "l") press("large");
    else if (event.key.toLowerCase() === "t") press("teacher");
    else if (event.key.toLowerCase() === "v" && live("views")) press("views");
    else if (event.key.toLowerCase() === "n" && live("notes")) press("notes");
    else return;
    event.preventDefault();
  });

  light.addEventListener("change", () => go());
  prose.addEventListener("scroll", look, { passive: true });
  const start = moments[Number(/^#m(\d+)$/.exec(location.hash)?.[1] ?? 0)] ?? moments[0];
  if (start !== moments[0]) start.scrollIntoView({ block: "start" });
  enter(start);
  setTimeout(() => document.body.classList.remove("opening"), OPENING_MS);
})();
