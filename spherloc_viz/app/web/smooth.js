// Moves the viewer smoothly where the server wants it: viser jumps there. The first view comes at once, and so does every
// view for who asked their system for less motion.
(() => {
  const SMOOTH_S = 0.16, EVERY_MS = 200, SETTLED_MS = 1200, SAME_MOVE_MS = 40;
  let readyAt = null, controls = null;

  const settled = () => readyAt !== null && performance.now() - readyAt > SETTLED_MS;
  const still = () => matchMedia("(prefers-reduced-motion: reduce)").matches || document.hidden;

  function smoothen(one) {
    const jump = one.setLookAt, usual = one.smoothTime;
    let from = null, begun = 0;
    const end = () => { one.smoothTime = usual; };
    one.addEventListener("rest", end);
    one.addEventListener("controlstart", end);
    one.setLookAt = (px, py, pz, tx, ty, tz, transition) => {
      if (transition || !settled() || still()) return jump(px, py, pz, tx, ty, tz, transition);
      // The server sends a place and what to look at as two messages, which are one move.
      if (performance.now() - begun > SAME_MOVE_MS) {
        const at = one.camera.position.clone(), target = one.camera.position.clone();
        from = [...one.getPosition(at, false).toArray(), ...one.getTarget(target, false).toArray()];
        begun = performance.now();
      }
      jump(...from, false);
      one.smoothTime = SMOOTH_S;
      return jump(px, py, pz, tx, ty, tz, true);
    };
  }

  setInterval(() => {
    if (readyAt === null && document.querySelector(".step-words")) readyAt = performance.now();
    const now = window.__viserMutable?.cameraControl;
    if (!now || now === controls) return;
    controls = now;
    smoothen(now);
  }, EVERY_MS);
})();
