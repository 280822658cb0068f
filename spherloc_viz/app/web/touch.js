// Tells the server what a person presses in the HTML and SVG that it sent: elements with data-touch="ACTION:ARGUMENT".
// With data-drag a drag across the element is told too; data-copy="TEXT" puts TEXT on the clipboard, or the page's address
// if TEXT is empty. And it tells which elements with data-view="NAME" are to be seen, so that what stands on a hidden tab
// need not be drawn. A key presses the element with data-key="KEY". Links within an element are followed, and do not press
// it. An element that gets another data-reveal="NAME" is scrolled to, also while what stands above it grows, until a person
// scrolls or presses. What a new link with data-fetch leads to is downloaded. When another step or problem comes, a panel
// that was scrolled past its title shows its beginning.
(() => {
  const TOUCHABLE = "[data-touch],[data-copy]", MIN_DRAG_PX = 6, LOOK_EVERY_MS = 150;
  const REVEAL_MS = 3000, COPIED_MS = 5000;
  let press = null, shade = null, seen = null, titled = null;
  let revealUntil = new Map();  // by the names of the elements that are to be revealed: until when they are scrolled to
  // The tabs of a step and of a link that were opened last, among the views and elsewhere, and the last report.
  let front = "", asked = "", elsewhere = "", told = "";
  let opening = "";  // the tab of a step that this script has pressed: it may come to the front after the next step
  const fetched = new Set();  // downloads that were begun

  function found(event) {
    const element = event.target instanceof Element ? event.target.closest(`${TOUCHABLE},a[href]`) : null;
    return element?.matches(TOUCHABLE) ? element : null;
  }

  const seenElements = (selector) => [...document.querySelectorAll(selector)].filter((one) => one.getClientRects().length > 0);
  const fraction = (value, start, size) => Math.min(1, Math.max(0, (value - start) / Math.max(size, 1)));

  function tell(action, box, event, from) {
    if (!document.querySelector("[data-ready]")) return;
    const at = (x, y) => [fraction(x, box.left, box.width), fraction(y, box.top, box.height)];
    window.spherlocReport(JSON.stringify({
      action,
      at: at(event.clientX, event.clientY),
      from: at(from.x, from.y),
      extend: Boolean(event.shiftKey || event.ctrlKey || event.metaKey),
    }));
  }

  function look() {
    if (!document.querySelector("[data-ready]")) return;
    document.documentElement.classList.add("opened");  // also when all panels are folded later
    seen = seenElements("[data-view]").map((view) => view.dataset.view).sort().join(",");
    const report = [seen, front, asked, elsewhere].join(";");
    if (report === told) return;
    told = report;
    const nowhere = { left: 0, top: 0, width: 1, height: 1 };
    tell(`views:${report}`, nowhere, { clientX: 0, clientY: 0, shiftKey: false }, { x: 0, y: 0 });
  }

  // Opens a tab of the views; false as long as it is not to be seen, as while the page is built or its panel is folded.
  // Tabs can be dragged, so that a click does nothing; Enter is what their own keys know. On a phone it is the other way.
  function openTab(name) {
    if ((seen ?? "").split(",").includes(name)) return true;
    const tab = [...document.querySelectorAll("[role=tab]")].find((one) => one.textContent.trim() === name);
    tab?.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true, cancelable: true }));
    if (document.body.classList.contains("views")) tab?.click();
    return false;
  }

  const linkedTab = () => document.querySelector("[data-tab]")?.dataset.tab ?? "";

  // Brings the tab to the front that goes with the step, unless a person has left the one that went with the last, or a
  // link asks for another one.
  function followStep() {
    const wanted = document.querySelector("[data-front]")?.dataset.front ?? "", views = (seen ?? "").split(",");
    const late = opening !== front && views.includes(opening);  // what was opened for a step that has been left since
    if (!wanted || (wanted === front && !late) || seen === null) return;
    if (front !== "" && !seenElements("[data-view]:not([data-side])").length) return; // no view is to be seen, as while one is drawn anew: nobody has left it
    const follows = (front === "" || views.includes(front) || views.includes(opening)) && linkedTab() === asked;
    if (follows) opening = wanted;
    if (follows && !openTab(wanted)) return;
    front = wanted;
  }

  // Brings the tabs to the front that a link asked for, "NAME NUMBER": as if a person had chosen them there.
  function followLink() {
    const opens = (wanted) => wanted === "" || openTab(wanted.split(" ")[0]), wanted = linkedTab();
    const another = document.querySelector("[data-elsewhere]")?.dataset.elsewhere ?? "";
    if (wanted !== asked && seen !== null && opens(wanted)) asked = wanted;
    if (another !== elsewhere && seen !== null && opens(another)) elsewhere = another;
  }

  function reveal() {
    const elements = seenElements("[data-reveal]"), now = Date.now(), before = revealUntil;
    revealUntil = new Map(elements.map(({ dataset: { reveal: name } }) => [name, before.get(name) ?? now + REVEAL_MS]));
    for (const element of elements) {
      if (now < revealUntil.get(element.dataset.reveal)) element.scrollIntoView({ block: "nearest" });
    }
  }

  function valueOf(name) {
    const label = [...document.querySelectorAll("label[for]")].find((one) => one.textContent === name);
    return document.getElementById(label?.htmlFor)?.value ?? "";
  }

  function showStep() {
    const title = seenElements(".step-title").find((one) => !one.closest(".captions"));
    const words = title ? [title.textContent, ...["Preset", "Scene", "Query"].map(valueOf)].join("\n") : titled;
    if (words === titled || document.querySelector('input[aria-expanded="true"]')) return; // a list that is open stays
    for (let box = title.parentElement; titled !== null && box; box = box.parentElement)
      if (title.getBoundingClientRect().top < box.getBoundingClientRect().top) box.scrollTop = 0;
    titled = words;
  }

  function fetchFiles() {
    for (const link of document.querySelectorAll("a[data-fetch]")) {
      if (fetched.has(link.href)) continue;
      fetched.add(link.href);
      link.click();
    }
  }

  async function copy(element) {
    const text = element.dataset.copy || location.href;
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      const area = document.createElement("textarea");
      area.value = text;
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
    element.classList.add("copied");
    setTimeout(() => element.classList.remove("copied"), COPIED_MS);
  }

  function pressMiddle(element, event) {
    const box = element.getBoundingClientRect(), middle = { x: box.left + box.width / 2, y: box.top + box.height / 2 };
    if (element.dataset.copy !== undefined) copy(element);
    else tell(element.dataset.touch, box, { clientX: middle.x, clientY: middle.y, shiftKey: event.shiftKey }, middle);
  }

  function drawShade(event) {
    const { box, from } = press;
    if (!shade) {
      shade = document.createElement("div");
      shade.className = "touch-shade";
      document.body.append(shade);
    }
    const ends = [from.x, Math.min(box.right, Math.max(box.left, event.clientX))].sort((a, b) => a - b);
    Object.assign(shade.style, {
      left: `${ends[0]}px`,
      width: `${ends[1] - ends[0]}px`,
      top: `${box.top}px`,
      height: `${box.height}px`,
    });
  }

  function end() {
    press = null;
    shade?.remove();
    shade = null;
  }

  for (const kind of ["wheel", "touchmove", "pointerdown"])
    addEventListener(kind, () => { for (const name of revealUntil.keys()) revealUntil.set(name, 0); }, { capture: true, passive: true });

  addEventListener("pointerdown", (event) => {
    const element = event.button === 0 ? found(event) : null;
    if (!element) return;
    const drag = element.closest("[data-drag]");
    // The server may replace the element while it is pressed, so its box is remembered.
    press = {
      element, drag, box: element.getBoundingClientRect(), from: { x: event.clientX, y: event.clientY },
      dragBox: drag?.getBoundingClientRect(),
    };
  }, true);

  addEventListener("pointermove", (event) => {
    if (!press?.drag) return;
    if (Math.abs(event.clientX - press.from.x) < MIN_DRAG_PX && !shade) return;
    press.box = press.dragBox;
    drawShade(event);
    event.preventDefault();
  }, true);

  addEventListener("pointerup", (event) => {
    if (!press) return;
    const { element, drag, box, from } = press, dragged = shade !== null;
    end();
    if (dragged) tell(drag.dataset.touch, box, event, from);
    else if (element.dataset.copy !== undefined) copy(element);
    else tell(element.dataset.touch, box, event, from);
  }, true);

  addEventListener("pointercancel", end, true);

  // What our other scripts on the page have to tell, and the tab that they open.
  addEventListener("spherloc-touch", ({ detail }) => {
    const nowhere = { left: 0, top: 0, width: 1, height: 1 };
    tell(detail, nowhere, { clientX: 0, clientY: 0 }, { x: 0, y: 0 });
  });
  addEventListener("spherloc-tab", ({ detail }) => openTab(detail));
  setInterval(() => { look(); followStep(); followLink(); showStep(); reveal(); fetchFiles(); }, LOOK_EVERY_MS);

  addEventListener("keydown", (event) => {
    const writing = event.target instanceof Element
      && event.target.closest("input:not([type=checkbox]):not([type=radio]),textarea,select,[contenteditable=true],[role=listbox]");
    if (event.key === "Escape" && !writing) {
      if (seenElements("[role=dialog]").length > 0) return; // what lies over the page is what it closes
      const corner = { left: 0, top: 0, width: 1, height: 1 };
      tell("deselect:", corner, { clientX: 0, clientY: 0 }, { x: 0, y: 0 });
      return;
    }
    // Many keyboards have brackets behind AltGr, which some systems call Ctrl and Alt.
    const held = (event.ctrlKey || event.metaKey) && !event.getModifierState("AltGraph");
    const keyed = writing || held || event.key.length > 1
      ? undefined
      : seenElements(`[data-key="${CSS.escape(event.key)}"]`)[0];
    if (keyed) {
      event.preventDefault();
      pressMiddle(keyed, event);
      return;
    }
    if ((event.key !== "Enter" && event.key !== " ") || !(event.target instanceof Element)) return;
    if (!event.target.matches(TOUCHABLE)) return;
    event.preventDefault();
    event.stopPropagation();
    pressMiddle(event.target, event);
  }, true);
})();
