// Shows the introduction that Python put on the page (data-introduction) on the first visit: a card over the canvas with
// a few moments, each of which takes the page to a step. Only the reader turns it: Continue, Back and Skip, the arrow keys, B, N
// and Escape. It is not shown again: the browser remembers it. Nor is it shown to whoever comes by a link. An element of the
// class "introduce" shows it again. Where panels that somebody has unfolded leave no room for it, it waits until they are
// folded again.
(() => {
  const SEEN = "spherloc-introduction", EVERY_MS = 250, ROOM_PX = 200;
  const linked = location.hash.length > 1;
  let card = null, told = null, index = 0;

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

  function button(className, words, pressed) {
    const made = element("button", className, words);
    made.addEventListener("click", pressed);
    return made;
  }

  function build() {
    card = element("div", "introduction", "");
    card.setAttribute("role", "dialog");
    card.setAttribute("aria-label", "Introduction");
    card.setAttribute("aria-live", "polite");
    const row = element("div", "row", "");
    row.append(
      element("span", "count", ""),
      button("skip", "Skip", end),
      button("back", "Back", () => turn(-1)),
      button("main", "Continue", () => (index === told.moments.length - 1 ? end() : turn(1))),
    );
    card.append(element("div", "title", ""), element("div", "told", ""), row);
    document.body.append(card);
  }

  const turn = (by) => show(Math.min(Math.max(index + by, 0), told.moments.length - 1));

  function show(number) {
    index = number;
    const { title, words, step } = told.moments[index], last = index === told.moments.length - 1;
    const part = (name) => card.querySelector(`.${name}`);
    part("title").textContent = title;
    part("told").textContent = words;
    part("count").textContent = `${index + 1} of ${told.moments.length}`;
    part("skip").hidden = last;
    part("back").hidden = index === 0;
    part("main").textContent = last ? "Close" : "Continue";
    if (document.activeElement === document.body || document.activeElement.hidden) part("main").focus();
    go(step);
  }

  function begin() {
    const source = document.querySelector("[data-introduction]");
    if (!source || card || !document.querySelector("canvas")) return;
    told = JSON.parse(source.dataset.introduction);
    build();
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
    card.hidden = box.width < ROOM_PX || document.body.classList.contains("unfolded");
    document.documentElement.classList.toggle("introducing", !card.hidden);
    if (card.hidden) return;
    document.documentElement.style.setProperty("--introduction", `${card.offsetHeight + 36}px`);
    const width = Math.min(32.4 * parseFloat(getComputedStyle(card).fontSize), box.width - 24);
    Object.assign(card.style, { left: `${box.left + (box.width - width) / 2}px`, width: `${width}px` });
  }

  setInterval(() => {
    if (!card) {
      if (!remembered() && !linked && !document.hidden) begin();
      return;
    }
    place();
  }, EVERY_MS);

  addEventListener("keydown", (event) => {
    if (!card || card.hidden || !event.isTrusted || event.ctrlKey || event.metaKey || event.altKey) return;
    const by = { ArrowLeft: -1, b: -1, ArrowRight: 1, n: 1 }[event.key];
    const taken = event.target instanceof Element && event.target.closest("input, textarea, [role=slider], [role=tab]");
    if (event.key === "Escape") end();
    else if (by && !taken) {
      event.stopPropagation(); // the canvas turns by the arrow keys, the step changes by B and N
      turn(by);
    }
  }, true);
  // The last card asks its reader to go on with the page: whoever does is done with it.
  addEventListener("pointerdown", (event) => {
    const last = card && !card.hidden && index === told.moments.length - 1;
    if (!last || !event.isTrusted || !(event.target instanceof Element) || event.target.closest(".introduction, canvas")) return;
    remember();
    close();
  }, true);
  addEventListener("click", (event) => {
    if (!(event.target instanceof Element) || !event.target.closest(".introduce")) return;
    close();
    begin();
  }, true);
})();
