// viser's note that it draws in software goes by itself: it covers the words in the canvas, and comes at every visit.
(() => {
  const EVERY_MS = 500, READ_MS = 5000, TITLE = "Software WebGL rendering detected";
  const since = new WeakMap();

  setInterval(() => {
    for (const close of document.querySelectorAll("[class*=Notification-closeButton]")) {
      if (!close.closest("[class*=Notification-root]")?.textContent.startsWith(TITLE)) continue;
      if (!since.has(close)) since.set(close, performance.now());
      if (performance.now() - since.get(close) > READ_MS) close.click();
    }
  }, EVERY_MS);
})();
