// Gives what viser leaves without one a name for screen readers: sliders and their number boxes (that of their label),
// buttons that are only a picture, and the canvas. What scrolls but has nothing to go to by key can be gone to itself.
(() => {
  const EVERY_MS = 300, CANVAS = "The scene in three dimensions; the steps beside it say what it shows";
  const PICTURES = { "list-search": "Search the commands" };
  const set = (one, name, value) => { if (one.getAttribute(name) !== value) one.setAttribute(name, value); };

  function nameFields() {
    for (const label of document.querySelectorAll("label[for]")) {
      const row = label.closest("[class*=Flex-root]"), words = label.textContent;
      if (!row || !words) continue;
      for (const thumb of row.querySelectorAll("[role=slider]")) set(thumb, "aria-label", words);
      for (const field of row.querySelectorAll("input:not([type=hidden]),textarea"))
        if (field.id !== label.htmlFor) set(field, "aria-label", words);
    }
  }

  function nameButtons() {
    for (const button of document.querySelectorAll("button:not([aria-label])")) {
      if (button.textContent.trim()) continue;
      const icon = [...(button.querySelector("svg")?.classList ?? [])].find((name) => name.startsWith("tabler-icon-"));
      const picture = icon?.slice("tabler-icon-".length) ?? "x";
      set(button, "aria-label", picture === "x" ? "Close" : PICTURES[picture] ?? picture.replaceAll("-", " "));
    }
  }

  function look() {
    nameFields();
    nameButtons();
    for (const canvas of document.querySelectorAll("canvas")) {
      if (canvas.width > 0) set(canvas, "role", "img");
      if (canvas.width > 0) set(canvas, "aria-label", CANVAS);
    }
    for (const area of document.querySelectorAll("[data-scrollarea-viewport]")) {
      if (area.querySelector("a[href],button,input,[tabindex='0']")) area.removeAttribute("tabindex");
      else set(area, "tabindex", "0");
    }
  }

  setInterval(look, EVERY_MS);
})();
