// Pressing a term (data-define="TERM") opens a window that tells what it means, and then what all others do
// (data-glossary, from Python). Escape, its button and a press beside it close it.
(() => {
  const TITLE = "What the words mean";

  function element(name, className, words) {
    const made = document.createElement(name);
    made.className = className;
    made.textContent = words;
    return made;
  }

  function row(term, meaning, className) {
    const made = element("p", className, `: ${meaning}`);
    made.prepend(element("b", "", term));
    return made;
  }

  function open(first) {
    const source = document.querySelector("[data-glossary]");
    const meanings = source ? JSON.parse(source.dataset.glossary) : {};
    if (!(first in meanings)) return;
    const dialog = element("dialog", "glossary", ""), head = element("div", "head", ""), list = element("div", "list", "");
    const close = element("button", "close", "×");
    dialog.setAttribute("aria-label", TITLE);
    close.setAttribute("aria-label", "Close");
    head.append(element("span", "title", TITLE), close);
    const others = Object.keys(meanings).filter((term) => term !== first);
    list.tabIndex = 0;
    list.append(...others.map((term) => row(term, meanings[term], "")));
    const foot = element("div", "foot", "");
    foot.append(element("button", "introduce", "Show the introduction again"));
    dialog.append(head, row(first, meanings[first], "first"), list, foot);
    close.addEventListener("click", () => dialog.close());
    dialog.addEventListener("click", (event) => {
      const { left, right, top, bottom } = dialog.getBoundingClientRect();
      const beside = event.clientX < left || event.clientX > right || event.clientY < top || event.clientY > bottom;
      const again = event.target instanceof Element && event.target.closest(".introduce");
      if (again || (event.target === dialog && beside)) dialog.close();
    });
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
  }

  const term = (event) => (event.target instanceof Element ? event.target.closest("[data-define]") : null)?.dataset.define;

  // Keys that mean something on the page mean nothing here. Goes before the scripts that listen for them.
  addEventListener("keydown", (event) => {
    if (document.querySelector("dialog.glossary[open]")) event.stopImmediatePropagation();
  }, true);

  addEventListener("click", (event) => {
    const asked = term(event);
    if (asked) open(asked);
  });
  addEventListener("keydown", (event) => {
    const asked = event.key === "Enter" || event.key === " " ? term(event) : undefined;
    if (!asked) return;
    event.preventDefault();
    open(asked);
  });
})();
