// Photographs that are dropped onto the page, files or folders of them, are sent to the server (data-drops, from Python,
// says where, and what it takes), with their progress in a card. Then the tab Open shows their folder.
(() => {
  const MARGIN_PX = 24, WIDEST_EM = 30, MOST_ENTRIES = 20000, MOST_NAMED = 3;
  const LOST = "the playground has not answered; see whether it still runs, and drop them again.";
  const LOOK_EVERY_MS = 500;
  let told = "";  // what Python has told: its panel may be folded when something is dropped
  let card = null;
  let sending = null;  // what ends the drop that is going on
  let progress = () => {};  // shows how far that is
  let another = "";  // what is said of one that came meanwhile

  function element(name, className, words) {
    const made = document.createElement(name);
    made.className = className;
    made.textContent = words;
    return made;
  }

  // Shows a card; its button calls `pressed`, which is "Close" without one.
  function show(title, words, pressed) {
    card?.remove();
    card = element("div", "opening", "");
    card.setAttribute("role", "status");
    const button = element("button", "", pressed ? "Cancel" : "Close"), bar = element("div", "bar", "");
    button.addEventListener("click", pressed ?? (() => card.remove()));
    bar.append(element("div", "", ""));
    bar.hidden = !pressed;
    card.append(element("div", "title", title), element("div", "words", words), bar, button);
    document.body.append(card);
    const box = document.querySelector("canvas")?.getBoundingClientRect() ?? document.body.getBoundingClientRect();
    const width = Math.min(WIDEST_EM * parseFloat(getComputedStyle(card).fontSize), box.width - MARGIN_PX);
    Object.assign(card.style, { left: `${box.left + (box.width - width) / 2}px`, width: `${width}px` });
  }

  function tell(words, share) {
    card.querySelector(".words").textContent = words;
    card.querySelector(".bar > div").style.width = `${100 * share}%`;
  }

  const counted = (count, what) => `${count.toLocaleString("en")} ${what}${count === 1 ? "" : "s"}`;
  const megabytes = (bytes) => (bytes < 1e6 ? "less than 1 MB" : `${Math.round(bytes / 1e6).toLocaleString("en")} MB`);
  // The same as a sentence; names of files stay as they are.
  const sentence = (words) => (/^[a-z]+ /.test(words) ? words.slice(0, 1).toUpperCase() + words.slice(1) : words);

  // All files in a dropped entry (FileSystemEntry), as [path, File]; `left` is how many are looked at, at most. What cannot
  // be read is left out.
  async function filesIn(entry, path, left) {
    if (left.entries-- <= 0) return [];
    if (entry.isFile) return new Promise((done) => entry.file((file) => done([[path, file]]), () => done([])));
    const reader = entry.createReader(), found = [];
    for (;;) {
      const some = await new Promise((done) => reader.readEntries(done, () => done([])));  // a hundred at a time
      if (some.length === 0) return found;
      for (const one of some) {
        if (!one.name.startsWith(".")) found.push(...await filesIn(one, path ? `${path}/${one.name}` : one.name, left));
      }
    }
  }

  // The name of what was dropped, empty for several, and its files as [path in it, File].
  async function filesOf(dropped) {
    const left = { entries: MOST_ENTRIES };
    if (dropped.length === 1 && dropped[0].isDirectory) return [dropped[0].name, await filesIn(dropped[0], "", left)];
    const files = [];
    for (const one of dropped) {
      files.push(...(one instanceof File ? [[one.name, one]] : await filesIn(one, one.name, left)));
    }
    return ["", files];
  }

  // What is sent, as [path, File, whether it is a photograph], how many of these there are, and what is left out.
  function sorted(files, takes) {
    const sent = [], unread = [], others = [], large = [], more = [];
    let photographs = 0;
    for (const [path, file] of files.sort(([a], [b]) => (a < b ? -1 : 1))) {
      const ending = /\.[^.]*$/.exec(file.name)?.[0].toLowerCase() ?? "";
      const isPhotograph = takes.photographs.includes(ending);
      if (takes.unread.includes(ending)) unread.push(file.name);
      else if (!isPhotograph && !takes.beside.includes(ending)) others.push(file.name);
      else if (file.size > (isPhotograph ? takes.mostBytes : takes.mostBytesBeside)) large.push(file.name);
      else if (sent.length === takes.mostFiles) more.push(file.name);
      else {
        sent.push([path, file, isPhotograph]);
        photographs += isPhotograph;
      }
    }
    const left = {
      "to be converted to JPEG or PNG": unread,
      "of another format": others,
      "too large": large,
      "more than are taken at once": more,
    };
    return { sent, photographs, left };
  }

  // A sentence on files that were left out, by why they were; empty without any.
  function aboutLeft(left) {
    const parts = Object.entries(left).filter(([, names]) => names.length > 0).map(([why, names]) => {
      const named = names.slice(0, MOST_NAMED).join(", ") + (names.length > MOST_NAMED ? ", …" : "");
      return `${counted(names.length, "file")} ${why} (${named})`;
    });
    return parts.length ? `Left out: ${parts.join("; ")}.` : "";
  }

  // Posts to the server; what it says if it refuses, else empty. Raises `Refused` if nothing of what was dropped is kept.
  class Refused extends Error {}

  async function post(address, told, body, signal) {
    const answer = await fetch(`${address}?${new URLSearchParams(told)}`, { method: "POST", body, signal });
    if (answer.ok) return "";
    const words = (await answer.text()).trim();
    if (answer.status !== 422) throw new Refused(words);
    return words;
  }

  async function send(title, name, { sent, photographs, left }, { address }) {
    const whole = sent.reduce((sum, [, file]) => sum + file.size, 0), refused = [];
    const all = counted(sent.length, photographs === sent.length ? "photograph" : "file");
    let done = 0, bytes = 0, kept = 0;
    progress = () => tell(`${done} of ${all}, ${megabytes(bytes)} of ${megabytes(whole)}. ${another}`, bytes / (whole || 1));
    progress();
    try {
      await post(`${address}begin`, { name, count: sent.length, bytes: whole }, null, sending.signal);
      for (const [path, file, isPhotograph] of sent) {
        const words = await post(`${address}file`, { name: path }, file, sending.signal);
        if (words) refused.push(words);
        else kept += isPhotograph;
        done += 1;
        bytes += file.size;
        progress();
      }
      if (kept === 0) throw new Refused(refused[0]);
      await post(`${address}end`, {}, null, sending.signal);
    } catch (error) {
      await post(`${address}cancel`, {}, null).catch(() => {});
      throw error;
    }
    dispatchEvent(new CustomEvent("spherloc-tab", { detail: "Open" }));
    const about = [aboutLeft(left), refused.length ? `Not taken: ${refused[0]}` : ""];
    const words = [...about, "The tab Open says what can be done with them."].filter(Boolean).join(" ");
    show(`${name ? `${name}: ` : ""}${counted(kept, "photograph")}`, words);
  }

  function look() {
    told = document.querySelector("[data-drops]")?.dataset.drops ?? told;
  }

  async function take(dropped, title) {
    look();
    if (!told) {
      const built = document.querySelector("[data-ready]") !== null;
      show(`${title} was not opened`, built ? "This page is one to look at: it takes no files." : "The page is still being built; drop it again when it is.");
      return;
    }
    if (sending) {
      another = `${title} was not opened: drop it when these are there.`;
      progress();
      return;
    }
    sending = new AbortController();
    [progress, another] = [() => {}, ""];
    const takes = JSON.parse(told), { signal } = sending;
    show(title, "Looking for photographs …", () => sending.abort());
    try {
      const [name, files] = await filesOf(dropped), what = sorted(files, takes);
      signal.throwIfAborted();
      if (what.photographs > 0) await send(title, name, what, takes);
      else {
        const about = `Drop photographs (${takes.photographs.join(", ")}), or a folder of them.`;
        show(`${title} was not opened`, ["It has no photographs that can be read.", aboutLeft(what.left), about].filter(Boolean).join(" "));
      }
    } catch (error) {
      if (signal.aborted) card?.remove();
      else show(`${title} was not opened`, sentence(error instanceof Refused ? error.message : LOST));
    } finally {
      sending = null;
    }
  }

  setInterval(look, LOOK_EVERY_MS);
  addEventListener("pointerdown", ({ target }) => { if (!sending && !card?.contains(target)) card?.remove(); }, true);
  for (const kind of ["dragover", "drop"]) {
    addEventListener(kind, (event) => {
      const given = event.dataTransfer;
      if (!given?.types.includes("Files") || event.defaultPrevented) return;
      event.preventDefault();
      if (kind !== "drop") return;
      // Both are gone once this event is over.
      const files = [...given.items].filter((item) => item.kind === "file");
      const dropped = files.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile()).filter(Boolean);
      if (dropped.length) take(dropped, dropped.length === 1 ? dropped[0].name : counted(dropped.length, "file"));
    });
  }
})();
