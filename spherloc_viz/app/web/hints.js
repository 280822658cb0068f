// Puts what a control of a panel says under a resting pointer (viser's hints) beside the panel, over the canvas: viser puts
// it above the control, where it covers the one before.
(() => {
  const SPACE_PX = 8, PANEL = "[style*='position: absolute; top: 0px; bottom: 0px']";
  const style = document.documentElement.style;

  // A hint comes half a second after the pointer, and goes by these in touch.css.
  addEventListener("pointerover", ({ target }) => {
    const box = target instanceof Element ? target.closest(PANEL)?.getBoundingClientRect() : undefined;
    if (!box || box.width > innerWidth / 2) return;
    const right = box.left + box.right > innerWidth;
    style.setProperty("--hint-left", right ? "auto" : `${box.right + SPACE_PX}px`);
    style.setProperty("--hint-right", right ? `${innerWidth - box.left + SPACE_PX}px` : "auto");
  }, { capture: true, passive: true });
})();
