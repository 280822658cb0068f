// The number box of a slider: Enter takes what was typed, within the slider's ends, which is said where it was beyond
// them, and a box that is left without a number has that of its slider again.
(() => {
  const TOLD_MS = 4000;
  let typed = null;  // the box that was typed into last, and what
  const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const isNumber = (one) => one instanceof HTMLInputElement && one.inputMode !== "" && row(one) !== null;
  const row = (one) => one.closest("[class*=Flex-root]:has([role=slider])");

  addEventListener("keydown", (event) => {
    if (event.key === "Enter" && isNumber(event.target)) event.target.blur();
  });
  addEventListener("input", ({ target, isTrusted }) => {
    if (isTrusted && isNumber(target)) typed = [target, Number(target.value.replaceAll(",", ""))];
  }, true);

  // Says which end of the slider a number was beyond.
  function tellEnd(box, number) {
    const slider = row(box).querySelector("[role=slider]");
    const [least, most] = ["min", "max"].map((end) => Number(slider.getAttribute(`aria-value${end}`)));
    if (!(number < least || number > most)) return;
    const note = document.createElement("div"), place = box.getBoundingClientRect();
    note.className = "end-note";
    note.setAttribute("role", "status");
    note.textContent = number > most ? `The largest is ${most}.` : `The least is ${least}.`;
    document.body.append(note);
    note.style.top = `${place.bottom + 2}px`;
    note.style.left = `${Math.max(0, place.right - note.offsetWidth)}px`;
    setTimeout(() => note.remove(), TOLD_MS);
  }

  addEventListener("focusout", (event) => {
    const box = event.target;
    if (!isNumber(box)) return;
    if (typed?.[0] === box) tellEnd(box, typed[1]);
    typed = null;
    if (box.value !== "") return;
    write.call(box, row(box).querySelector("[role=slider]").getAttribute("aria-valuenow"));
    box.dispatchEvent(new Event("input", { bubbles: true }));
  });
})();
