// The scenes of an exported lesson: viser's page in a frame with one recorded scene inside, and the numbers of its run.
// States are "at=PLACE". The old scene stays until the new one is drawn. ``told`` is called with the numbers.
function openScene(told) {
  const SETTLE_MS = 200, EVERY_MS = 60, PATIENCE_MS = 20000;
  const viewer = JSON.parse(document.getElementById("viewer").textContent);
  const numbers = JSON.parse(document.getElementById("numbers").textContent);
  const box = document.querySelector(".scene");
  let place = "", timer = 0;

  function load() {
    const code = document.getElementById(`scene-${place}`).textContent;
    const frame = Object.assign(document.createElement("iframe"), { title: "The recorded scene" });
    const begun = performance.now(), own = place;
    frame.srcdoc = viewer.replace("</head>", () => `<script>${code}<\/script></head>`);
    frame.className = "coming";
    box.append(frame);
    const look = setInterval(() => {
      const tree = frame.contentWindow?.__viserSceneTree?.getState?.() ?? {};
      const drawn = Object.values(tree).some((node) => node.message?.props);
      if (own === place && !drawn && performance.now() - begun < PATIENCE_MS) return;
      clearInterval(look);
      if (own !== place) return frame.remove();
      requestAnimationFrame(() => requestAnimationFrame(() => {
        if (own !== place) return frame.remove();
        for (const other of [...box.children]) if (other !== frame) other.remove();
        frame.className = "";
        told(numbers[own]);
      }));
    }, EVERY_MS);
  }

  return {
    show(state) {
      const next = new URLSearchParams(state).get("at");
      if (next === place) return told(numbers[place]);
      place = next;
      clearTimeout(timer);
      timer = setTimeout(load, SETTLE_MS);
    },
  };
}
