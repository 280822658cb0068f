// Two ways of showing a step with few words, for a lecture and for a phone. On a narrow screen, and in a zoomed window,
// the settings are folded away at the start; on a narrow one what the step says stands below the canvas, with Previous
// and Next, and with it what is said of a match that was tapped and, at the last step, of a failure; a button has the
// view that goes with the step take the place of the words. The projector view, key L (Escape ends it) or an element of
// the class "projector-toggle", folds the panel on the right and has the view that goes with the step and, in large
// type, what the step says and at the last one what is said of a failure on the left, for which it asks the server for
// room (projector:WIDTH of the window). The server is told too how wide the window is (window:WIDTH). At either end of
// the steps the button that leads on is disabled, in the panel too.
(() => {
  const EVERY_MS = 150, FOLDED_MS = 2000, NARROW_PX = 600, ROOMY_PX = 1000, FOLD = "Collapse panel area", UNFOLD = "Expand column";
  const DESELECT = '<button class="deselect" data-touch="deselect:">Deselect</button>';
  const SHEET = '[class*=Paper-root][style*="position: fixed; bottom: 0px"]';
  let bar = null, words = null, number = null, turn = null;
  let projector = false, viewing = false, folded = false, roomMade = false, foldedHere = false;
  let toldWidth = 0, toldWindow = 0, toggledAt = -Infinity;

  // While the settings are unfolded on a narrow screen, they take the place of the captions.
  const small = () => innerWidth < NARROW_PX;
  const unfolded = () => [...document.querySelectorAll("[data-ready]")].some((one) => one.getClientRects().length > 0);
  const narrow = () => small() && folded && (viewing || !unfolded());
  const tell = (detail) => dispatchEvent(new CustomEvent("spherloc-touch", { detail }));
  const ofRightColumn = (label) =>
    document.querySelector(`[style*="top: 0px; bottom: 0px; right: 0px"] [aria-label="${label}"]`);

  // viser gives the focus, and its frame, to the panel that was folded or unfolded: nobody has asked for that.
  function fold(label) {
    const found = ofRightColumn(label);
    found?.click();
    toggledAt = performance.now();
    return found !== null;
  }

  function button(text, label, press) {
    const made = document.createElement("button");
    made.textContent = text;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", press);
    return made;
  }

  function build() {
    bar = document.createElement("div");
    bar.className = "captions";
    bar.setAttribute("role", "region");
    bar.setAttribute("aria-label", "What the step says");
    words = document.createElement("div");
    words.setAttribute("aria-live", "polite");
    const row = document.createElement("div");
    row.className = "row";
    row.append(
      button("‹ Previous", "Previous step", () => tell("move:Previous")),
      button("Next ›", "Next step", () => tell("move:Next")),
    );
    const close = button("Close (L)", "Close the projector view", toggle);
    close.className = "close";
    number = document.createElement("span");
    number.className = "place";
    turn = button("", "", turnOver);
    turn.className = "turn";
    row.append(turn, number, close);
    bar.append(words, row);
    document.body.append(bar);
  }

  // Only what is new is written: a screen reader would read it again.
  function fill() {
    const told = [".match-words", ".diagnosis-words", ".step-words", ".offered-words"]
      .filter((kind) => narrow() || kind !== ".match-words")
      .map((kind) => [kind, document.querySelector(kind)?.innerHTML])
      .filter(([, html]) => html)
      .map(([kind, html]) => `<div class="of-${kind.slice(1)}">${html}${kind === ".match-words" ? DESELECT : ""}</div>`)
      .join("");
    if (words.dataset.told === told) return;
    number.textContent = document.querySelector(".step-title")?.dataset.place ?? "";
    const match = (html) => html?.split(/<div class="of-(?:diagnosis|step)-words">/)[0];
    const walked = match(words.dataset.told) === match(told);
    words.dataset.told = told;
    words.innerHTML = told;
    words.scrollTop = walked ? words.querySelector(".of-diagnosis-words,.of-step-words").offsetTop - words.offsetTop : 0;
  }

  function markEnds() {
    const end = document.querySelector(".step-words")?.dataset.end;
    for (const one of document.querySelectorAll("button")) {
      const name = one.textContent.trim();
      const last = { "Previous": "first", "‹ Previous": "first", "Next": "last", "Next ›": "last" }[name];
      if (last && one.disabled !== (end === last)) one.disabled = end === last;
    }
  }

  function place() {
    const panel = narrow() ? null : document.querySelector("[data-view]")?.closest("[style*='left: 0px']");
    bar.style.width = `${panel ? panel.getBoundingClientRect().width : innerWidth}px`;
    document.body.style.setProperty("--captions", `${bar.getBoundingClientRect().height}px`);
  }

  // The canvas of a narrow screen ends where the unfolded settings begin, so that a slider moves what can be seen.
  function leaveRoom() {
    const found = small() && unfolded() && !viewing ? document.querySelector(SHEET) : null;
    document.body.classList.toggle("unfolded", found !== null);
    if (found) document.body.style.setProperty("--canvas", `${Math.round(found.getBoundingClientRect().top)}px`);
  }

  function toggle() {
    projector = !projector;
    document.body.classList.toggle("projector", projector);
    const roomy = innerWidth >= ROOMY_PX;
    fold(projector || !roomy ? FOLD : UNFOLD);
    if (!projector) roomMade = foldedHere = !roomy;
    folded = projector;
    look();
  }

  // Once, when the page is ready: what is on the screen first is the scene.
  function foldSettings() {
    if (folded || !small() || !document.querySelector("[data-ready]")) return;
    folded = pressTitle();
  }

  // A window that has just become narrow still shows the panel of the wide one for a moment.
  function pressTitle() {
    const within = document.querySelector(SHEET)?.querySelectorAll("div") ?? [];
    const title = [...within].find((one) => !one.childElementCount && one.textContent === "spherloc");
    title?.click();
    return title !== undefined;
  }

  // Where the words of the step stand on a narrow screen, the views are shown, or the words again: the same sheet as the
  // settings', of which nothing else is to be seen.
  function turnOver() {
    viewing = !viewing;
    pressTitle();
    look();
  }

  function showViews() {
    if (viewing && !small()) viewing = false;
    document.body.classList.toggle("views", viewing);
    if (turn) {
      const view = document.querySelector("[data-front]")?.dataset.front || "Views";
      turn.textContent = viewing ? "Words" : view;
      turn.setAttribute("aria-label", viewing ? "What the step says" : `The view of the step: ${view}`);
    }
    const views = viewing ? document.querySelector("[data-view=Yaw]")?.closest("[class*=Tabs-root]") : null;
    if (views?.getClientRects().length && !views.querySelector("[role=tab]")) views.firstElementChild.click();
  }

  // In a window that is not that narrow, as a zoomed one, two panels would leave a strip of the canvas: the right one is
  // folded, until the window is wider again or a person unfolds it. A lesson, which shows the page in a frame, hides them
  // itself.
  function makeRoom() {
    if (small() || projector || window !== window.top || !document.querySelector("[data-ready]")) return;
    if (innerWidth >= ROOMY_PX) {
      if (foldedHere) fold(UNFOLD);
      roomMade = foldedHere = false;
    } else if (!roomMade) {
      roomMade = foldedHere = fold(FOLD);
    }
  }

  function look() {
    if (!document.body) return; // the page is still being read
    if (!small() && !projector) folded = false; // viser unfolds them when the window is narrow again
    foldSettings();
    makeRoom();
    const wanted = (projector || narrow()) && document.querySelector(".step-words") && !document.querySelector(".introduction");
    document.body.classList.toggle("narrow", narrow());
    showViews();
    leaveRoom();
    if (!wanted) {
      bar?.remove();
      bar = null;
    } else {
      if (!bar) build();
      fill();
      place();
    }
    markEnds();
    const ready = document.querySelector("[data-ready]");
    if (innerWidth !== toldWindow && ready) {
      toldWindow = innerWidth;
      tell(`window:${innerWidth}`);
    }
    const width = projector ? innerWidth : 0;
    if (width !== toldWidth && ready) {
      toldWidth = width;
      tell(`projector:${width}`);
    }
  }

  setInterval(look, EVERY_MS);
  for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => { toggledAt = -Infinity; }, true);
  addEventListener("focusin", ({ target }) => {
    const given = performance.now() - toggledAt < FOLDED_MS && target instanceof HTMLElement && !bar?.contains(target);
    if (given && !target.matches("input,textarea,[role=slider]")) target.blur();
  }, true);
  addEventListener("keydown", (event) => {
    const writing = event.target instanceof Element
      && event.target.closest("input:not([type=checkbox]):not([type=radio]),textarea,select,[contenteditable=true]");
    // The first press of Escape deselects a match.
    const leaves = event.key === "Escape" && projector && !document.querySelector(".match-words,[role=dialog]");
    if (writing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key.toLowerCase() !== "l" && !leaves) return;
    event.preventDefault();
    toggle();
  }, true);
  addEventListener("click", (event) => {
    if (event.target instanceof Element && event.target.closest(".projector-toggle")) toggle();
  }, true);
})();
