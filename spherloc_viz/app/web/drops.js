// Files that are dropped onto the page would open in its place. It stays, and a card says how photographs are opened: no
// page is told where a dropped folder lies.
(() => {
  const MARGIN_PX = 24, WIDEST_EM = 30, ADVICE = "A page is not told where dropped files lie. Open the folder under Open; "
    + "spherloc play --allow FOLDER lets pages look into it.";
  let card = null;

  function element(name, className, words) {
    const made = document.createElement(name);
    made.className = className;
    made.textContent = words;
    return made;
  }

  function show(dropped) {
    card?.remove();
    card = element("div", "opening", "");
    card.setAttribute("role", "status");
    const close = element("button", "", "Close");
    close.addEventListener("click", () => card.remove());
    card.append(element("div", "title", `${dropped} was not opened`), element("div", "words", ADVICE), close);
    document.body.append(card);
    const box = document.querySelector("canvas")?.getBoundingClientRect() ?? document.body.getBoundingClientRect();
    const width = Math.min(WIDEST_EM * parseFloat(getComputedStyle(card).fontSize), box.width - MARGIN_PX);
    Object.assign(card.style, { left: `${box.left + (box.width - width) / 2}px`, width: `${width}px` });
  }

  addEventListener("pointerdown", ({ target }) => { if (!card?.contains(target)) card?.remove(); }, true);
  for (const kind of ["dragover", "drop"]) {
    addEventListener(kind, (event) => {
      const given = event.dataTransfer;
      if (!given?.types.includes("Files") || event.defaultPrevented) return;
      event.preventDefault();
      if (kind === "drop") show(given.files[0]?.name ?? "What was dropped");
    });
  }
})();
