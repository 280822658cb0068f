// The scenes of an exported lesson: viser's page in a frame with one recorded scene inside, and the numbers of its run.
// States are "at=PLACE". The old scene stays until the new one is drawn, but it stands still: without a graphics card
// its own frames would keep the new one waiting. ``told`` is called with the numbers of the new one when it is drawn.
function openScene(told) {
  const SETTLE_MS = 200, EVERY_MS = 60, PATIENCE_MS = 20000;
  const viewer = JSON.parse(document.getElementById("viewer").textContent);
  const numbers = JSON.parse(document.getElementById("numbers").textContent);
  const box = document.querySelector(".scene");
  let place = "", turn = 0, drawn = 0, timer = 0;  // turns count what was asked for

  function load() {
    const code = document.getElementById(`scene-${place}`).textContent;
    const frame = Object.assign(document.createElement("iframe"), { title: "The recorded scene" });
    const begun = performance.now(), own = turn;
    frame.srcdoc = viewer.replace("</head>", () => `<script>${code}<\/script></head>`);
    frame.className = "coming";
    for (const other of box.querySelectorAll(".coming")) other.remove();
    box.append(frame);
    const look = setInterval(() => {
      const tree = frame.contentWindow?.__viserSceneTree?.getState?.() ?? {};
      const filled = Object.values(tree).some((node) => node.message?.props);
      if (own === turn && !filled && performance.now() - begun < PATIENCE_MS) return;
      clearInterval(look);
      if (own !== turn) return frame.remove();
      requestAnimationFrame(() => requestAnimationFrame(() => {
        if (own !== turn) return frame.remove();
        for (const other of [...box.children]) if (other !== frame) other.remove();
        frame.className = "";
        drawn = own;
        told(numbers[place]);
      }));
    }, EVERY_MS);
  }

  return {
    show(state) {
      const next = new URLSearchParams(state).get("at");
      if (next === place) {
        if (drawn === turn) told(numbers[place]);
        return;
      }
      place = next;
      turn += 1;
      for (const { contentWindow } of box.children) contentWindow.requestAnimationFrame = () => 0;
      clearTimeout(timer);
      timer = setTimeout(load, SETTLE_MS);
    },
  };
}
