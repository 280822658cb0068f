// A press counts for what was under the pointer when it went down, also if the page has moved beneath it before it went
// up, or has drawn the same anew: a browser makes a click of the two only where both meet the same element. And who has
// chosen from a list goes on with keys, which must not be written into its box. A finger on the canvas picks as a mouse
// does: a browser lets the element under a finger capture it, and viser takes what is captured for a drag of one of its
// handles.
(() => {
  const PRESSABLE = "button,a[href],label,summary,input,[data-define],[role=option],[role=checkbox],[role=switch]";
  const STILL_PX = 4, AFTER_CHOICE_MS = 50;
  let down = null, leaving = 0;

  const pressable = (target) => (target instanceof Element ? target.closest(PRESSABLE) : null);

  addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" && event.target instanceof HTMLCanvasElement) {
      event.target.releasePointerCapture(event.pointerId);
    }
    const element = event.isPrimary && event.button === 0 ? pressable(event.target) : null;
    down = element && { element, html: element.outerHTML, x: event.clientX, y: event.clientY };
    clearTimeout(leaving);
  }, true);

  addEventListener("pointerup", (event) => {
    const pressed = down;
    down = null;
    if (!pressed || !(event.target instanceof Node) || pressed.element.contains(event.target)) return;
    if (Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) >= STILL_PX) return;
    const beneath = pressable(event.target);
    if (pressed.element.isConnected) pressed.element.click();
    else if (beneath?.outerHTML === pressed.html) beneath.click();
  }, true);

  addEventListener("pointercancel", () => { down = null; }, true);
  // A checkbox that was clicked would keep the focus, and with it the keys of the steps.
  addEventListener("click", (event) => {
    if (event.detail > 0 && event.target instanceof HTMLInputElement && event.target.type === "checkbox") event.target.blur();
  });
  addEventListener("keydown", () => clearTimeout(leaving), true);

  addEventListener("click", (event) => {
    if (!(event.target instanceof Element) || !event.target.closest("[role=option]")) return;
    const field = document.activeElement;
    clearTimeout(leaving);
    leaving = setTimeout(() => {
      if (field instanceof HTMLInputElement && field === document.activeElement) field.blur();
    }, AFTER_CHOICE_MS);
  }, true);
})();
