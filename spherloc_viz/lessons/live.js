// The live scene of a lesson: the playground's own page in a frame, driven through its address as a link would be
// (app/web/link.js). It tells the numbers of its run when it is asked to. ``told`` is called with them.
function openScene(told) {
  const EVERY_MS = 150;
  const frame = Object.assign(document.createElement("iframe"), { title: "The live scene" });
  document.querySelector(".scene").append(frame);
  let wanted = "", sent = "", landed = "", heard = false;

  const inside = (selector) => frame.contentDocument?.querySelector(selector);

  // The lesson is the panel here: of the playground's own only the views can be seen, if somebody wants (touch.css).
  function fold() {
    const look = frame.contentDocument?.body?.classList, views = document.body.classList.contains("views");
    if (!look || (look.contains("in-lesson") && look.contains("in-lesson-views") === views)) return;
    look.add("in-lesson");
    look.toggle("in-lesson-views", views);
    frame.contentWindow.dispatchEvent(new Event("resize"));
  }

  // viser says that it draws in software, in a note that lies over the scene.
  function closeNote() {
    for (const note of frame.contentDocument?.querySelectorAll("[class*=Notification-root]") ?? [])
      if (note.textContent.startsWith("Software WebGL")) note.querySelector("button")?.click();
  }

  function tell(detail) {
    const page = frame.contentWindow;
    page.dispatchEvent(new page.CustomEvent("spherloc-touch", { detail }));
  }

  setInterval(() => {
    fold();
    closeNote();
    const said = inside("[data-address]");
    if (!said || !inside("[data-ready]")) return;
    if (wanted !== sent) {
      sent = wanted;
      frame.contentWindow.location.replace(`/#${wanted}`);
      return;
    }
    if (!said.dataset.numbers) tell("numbers:");
    else if (frame.contentWindow.location.hash === `#${said.dataset.address}`) {
      if (heard && landed === said.dataset.numbers) return;
      heard = true;
      landed = said.dataset.numbers;
      told(JSON.parse(landed));
    }
  }, EVERY_MS);

  return {
    show(state) {
      wanted = state;
      heard = false;
      if (frame.getAttribute("src")) return;
      sent = wanted;
      frame.src = `/#${wanted}`;
    },
  };
}
