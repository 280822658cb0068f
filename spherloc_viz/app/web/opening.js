// While another scene is opened, a card over the canvas says how far that is (data-opening, from Python) and ends it
// when somebody wants ("cancel:").
(() => {
  const EVERY_MS = 150, MARGIN_PX = 24, WIDEST_EM = 30;
  let card = null, told = "";

  function element(name, className, words) {
    const made = document.createElement(name);
    made.className = className;
    made.textContent = words;
    return made;
  }

  function build() {
    card = element("div", "opening", "");
    card.setAttribute("role", "status");
    const cancel = element("button", "", "Cancel");
    cancel.addEventListener("click", () => dispatchEvent(new CustomEvent("spherloc-touch", { detail: "cancel:" })));
    const bar = element("div", "bar", "");
    bar.append(element("div", "", ""));
    card.append(element("div", "title", ""), element("div", "words", ""), bar, cancel);
    document.body.append(card);
  }

  function place() {
    const box = document.querySelector("canvas")?.getBoundingClientRect();
    if (!box) return;
    const width = Math.min(WIDEST_EM * parseFloat(getComputedStyle(card).fontSize), box.width - MARGIN_PX);
    Object.assign(card.style, { left: `${box.left + (box.width - width) / 2}px`, width: `${width}px` });
  }

  setInterval(() => {
    const now = document.querySelector("[data-opening]")?.dataset.opening ?? "";
    if (now !== told && !now) {
      card?.remove();
      card = null;
    } else if (now) {
      if (!card) build();
      const { title, words, share } = JSON.parse(now);
      if (now !== told) {
        card.querySelector(".title").textContent = title;
        card.querySelector(".words").textContent = words;
        card.querySelector(".bar").hidden = share === null;
        card.querySelector(".bar > div").style.width = `${100 * share}%`;
      }
      place();
    }
    told = now;
  }, EVERY_MS);
})();
