// Says below each entry of a list what it is there to show (app/controls/choices.py tells what).
(() => {
  const EVERY_MS = 300;
  let told = "{}", known = {};

  setInterval(() => {
    const now = document.querySelector("[data-choices]")?.dataset.choices ?? "{}";
    if (now !== told) [told, known] = [now, JSON.parse(now)];
    for (const option of document.querySelectorAll("[role=option]")) {
      const about = known[option.textContent] ?? "";
      if (about === (option.dataset.about ?? "")) continue;
      if (about) option.dataset.about = about;
      else delete option.dataset.about;
      option.setAttribute("aria-description", about);
    }
  }, EVERY_MS);
})();
