// Shows the introduction that Python put on the page (data-introduction) on the first visit: a card over the canvas with
// a few moments, each of which takes the page to a step. It goes on by itself until somebody presses elsewhere, can be
// skipped, and is not shown again: the browser remembers it. Nor is it shown to whoever comes by a link. An element of the class "introduce" shows it again.
(() => {
  const SEEN = "spherloc-introduction", EVERY_MS = 250, MOMENT_MS = 8000;
  const linked = location.hash.length > 1;
  let card = null, told = null, index = 0, left = 0, paused = false;

  const remembered = () => {
    try {
      return localStorage.getItem(SEEN) !== null;
    } catch {
      return true;
    }
  };
  const remember = () => {
    try {
      localStorage.setItem(SEEN, "seen");
    } catch {
      // Without storage it is shown once a page.
    }
  };
  const go = (key) => dispatchEvent(new CustomEvent("spherloc-touch", { detail: `step:${key}` }));

  function element(name, className, words) {
    const made = document.createElement(name);
    made.className = className;
    made.textContent = words;
    return made;
  }

  function draw() {
    const { title, words } = told.moments[index], last = index === told.moments.length - 1;
    const skip = element("button", "", "Skip"), next = element("button", "main", last ? "Begin" : "Next");
    skip.addEventListener("click", end);
    next.addEventListener("click", () => (last ? end() : show(index + 1)));
    const row = element("div", "row", "");
    row.append(element("span", "count", `${index + 1} of ${told.moments.length}`), ...(last ? [] : [skip]), next);
    const bar = element("div", "bar", "");
    bar.append(element("div", "", ""));
    card.replaceChildren(element("div", "title", title), element("div", "", words), row, bar);
  }

  function show(number) {
    index = number;
    left = MOMENT_MS;
    draw();
    go(told.moments[index].step);
  }

  function begin() {
    const source = document.querySelector("[data-introduction]");
    if (!source || card || !document.querySelector("canvas")) return;
    told = JSON.parse(source.dataset.introduction);
    card = element("div", "introduction", "");
    card.setAttribute("role", "dialog");
    card.setAttribute("aria-label", "Introduction");
    card.setAttribute("aria-live", "polite");
    document.body.append(card);
    paused = false;
    show(0);
    place();
  }

  function end() {
    remember();
    close();
    go(told.end);
  }

  function close() {
    card?.remove();
    card = null;
    document.documentElement.classList.remove("introducing");
  }

  // The canvas ends above the card, so that the card covers nothing of it: the server fits its view to what is left.
  function place() {
    const box = document.querySelector("canvas")?.getBoundingClientRect();
    if (!box) return;
    document.documentElement.style.setProperty("--introduction", `${card.offsetHeight + 36}px`);
    document.documentElement.classList.add("introducing");
    const width = Math.min(32.4 * parseFloat(getComputedStyle(card).fontSize), box.width - 24);
    Object.assign(card.style, { left: `${box.left + (box.width - width) / 2}px`, width: `${width}px` });
  }

  setInterval(() => {
    if (!card) {
      if (!remembered() && !linked && !document.hidden) begin();
      return;
    }
    place();
    if (paused || document.hidden) return;
    left -= EVERY_MS;
    const share = 100 * (1 - Math.max(0, left) / MOMENT_MS);
    card.querySelector(".bar > div").style.width = `${share}%`;
    if (left <= 0 && index < told.moments.length - 1) show(index + 1);
  }, EVERY_MS);

  addEventListener("pointerdown", (event) => {
    if (card && event.isTrusted && !(event.target instanceof Element && event.target.closest(".introduction"))) paused = true;
  }, true);
  addEventListener("keydown", (event) => {
    if (!card || !event.isTrusted) return;
    if (event.key === "Escape") end();
    else if (!(event.target instanceof Element && event.target.closest(".introduction"))) paused = true;
  }, true);
  addEventListener("click", (event) => {
    if (!(event.target instanceof Element) || !event.target.closest(".introduce")) return;
    close();
    begin();
  }, true);
})();
