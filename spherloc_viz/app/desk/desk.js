"use strict";
// The page: filters, groups, table, the chosen run, keys, views, sets, comparisons and reports.

const SETTINGS = JSON.parse(document.body.dataset.settings);
const FILTERS = ["outcome", "diagnosis", "estimator", "scene", "source", "labels"];
const GROUPED = ["diagnosis", "scene", "estimator", "outcome", "changes", "source", "name"];
const MAX_CHIPS = 6, ALL_CHIPS = 40, MAX_GROUP_COLUMNS = 6, EXAMPLES = 4, ROW_PX = 34;
const WIDTHS = {
  outcome: 90, diagnosis: 138, scene: 128, name: 190, changes: 150, labels: 150, title: 190, created: 110, query: 120, estimator: 104,
  outlier_rate: 60, rotation_error_deg: 72, translation_error_m: 78, rotation_sd_deg: 74, position_sd_m: 104, certificate_gap: 80,
  time_ms: 60, correspondences: 60, inliers: 60, seed: 56, steps: 56, key_step: 60,
};
const MARK_AND_PICTURE_PX = 84;
const DEFAULT_KEYS = ["real failure", "bad map", "bad truth", "calibration", "repeated structure", "look again", "known", "fixed", "ignore"];
const SEEN = "seen";
const NEWS_MS = 15000;
const STRIP_WORDS = "Runs whose value is unknown lie in the shaded strip.";
const START = {
  search: "", chosen: {}, ranges: {}, lasso: null, only: null, pages: false, sort: "created", descending: true,
  columns: ["outcome", "diagnosis", "outlier_rate", "rotation_error_deg", "translation_error_m", "scene", "estimator", "position_sd_m", "certificate_gap", "time_ms", "labels"],
  x: "outlier_rate", y: "rotation_error_deg", rows: "diagnosis", across: "scene", keys: DEFAULT_KEYS,
};
const byId = (id) => document.getElementById(id);
const count = (number) => number.toLocaleString("en");
const plural = (number, noun) => `${count(number)} ${noun}${number === 1 ? "" : "s"}`;

let runs, reviews, state = structuredClone(START);
let fits, listed = new Int32Array(0), chosen = -1, anchor = -1;
const marked = new Set(), unfolded = new Set(), allChips = new Set(), axes = new Map();
let newsTimer = 0;
let saved = { views: {}, sets: {}, folders: [] }, waiting = false;
const colors = [], hexes = [];
let outcomeCodes;

function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function say(words, wrong = false) {
  const news = byId("news");
  news.textContent = words;
  news.hidden = !words;
  news.classList.toggle("wrong", wrong);
  clearTimeout(newsTimer);
  if (!wrong) newsTimer = setTimeout(() => { news.hidden = true; }, NEWS_MS);
}

// Lengths are told in the unit of the listed maps, of which some may have none.
const title = (name) => (SETTINGS.columns[name] || [name])[0].replace("{unit}", runs.unit);

// --- the state: in the address, so that a link and the browser's back button bring it back -------------------------

function stateText() {
  const kept = {};
  for (const [name, value] of Object.entries(state)) {
    if (name === "only" && value && value.length > 60) continue;
    if (JSON.stringify(value) !== JSON.stringify(START[name])) kept[name] = value;
  }
  return Object.keys(kept).length ? encodeURIComponent(JSON.stringify(kept)) : "";
}

// Whoever sent the link may have written anything: what does not fit is left out.
function readState(text) {
  const found = structuredClone(START);
  let told = {};
  try { told = JSON.parse(decodeURIComponent(text)); } catch { return found; }
  if (typeof told !== "object" || told === null) return found;
  const isText = (value) => typeof value === "string" && value.length < 400;
  const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
  const spot = (value) => Array.isArray(value) && value.length === 2 && value.every(isNumber);
  const isRange = (value) => Array.isArray(value) && (value.length === 2 || value.length === 3) && value.every(isNumber);
  if (isText(told.search)) found.search = told.search;
  for (const [name, values] of Object.entries(told.chosen || {})) {
    if ((name in runs.texts || name === "labels") && Array.isArray(values)) found.chosen[name] = values.filter(isText);
  }
  for (const [name, range] of Object.entries(told.ranges || {})) if (name in runs.numbers && isRange(range)) found.ranges[name] = range;
  if (Array.isArray(told.lasso) && told.lasso.length < 3000 && told.lasso.every(spot)) found.lasso = told.lasso;
  if (Array.isArray(told.only)) found.only = told.only.filter(isText);
  if (runs.has(told.sort)) found.sort = told.sort;
  found.descending = told.descending !== false;
  found.pages = told.pages === true;
  if (Array.isArray(told.columns)) found.columns = told.columns.filter((name) => name in SETTINGS.columns);
  for (const name of ["x", "y"]) if (told[name] in runs.numbers && told[name] in SETTINGS.columns) found[name] = told[name];
  for (const name of ["rows", "across"]) if (GROUPED.includes(told[name])) found[name] = told[name];
  if (Array.isArray(told.keys)) found.keys = DEFAULT_KEYS.map((label, k) => (isText(told.keys[k]) ? told.keys[k] : label));
  return found;
}

function change(differences, remember = true) {
  Object.assign(state, differences);
  const text = stateText();
  const address = text ? `#${text}` : location.pathname;
  if (remember) history.pushState(null, "", address); else history.replaceState(null, "", address);
  update();
}

// --- what is listed ------------------------------------------------------------------------------------------------

function update() {
  fits = runs.fitting(state);
  listed = runs.listed(fits, state.sort, state.descending);
  if (document.activeElement !== byId("search")) byId("search").value = state.search;
  soon();
}

function soon() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}

function draw() {
  const failures = runs.counts(fits, "outcome").find(([outcome]) => outcome === "failure");
  const others = runs.pageRuns && !state.pages && runs.others ? `, ${plural(runs.pageRuns, "page run")} apart` : "";
  byId("counts").textContent = `${plural(listed.length, "run")} of ${count(runs.count)} listed` +
    (failures ? `, ${plural(failures[1], "failure")}` : "") + others;
  drawChips(); drawMatrix(); drawPlots(); drawHead(); drawRows(); drawTools();
  document.body.dataset.listed = listed.length;
}

function filterState(without) {
  return { ...state, chosen: { ...state.chosen, [without]: [] } };
}

function toggled(name, value) {
  const now = state.chosen[name] || [];
  const next = now.includes(value) ? now.filter((other) => other !== value) : [...now, value];
  change({ chosen: { ...state.chosen, [name]: next } });
}

function chip(words, number, on, press, hint, color) {
  const dot = color ? [element("span", { className: "dot", style: `background:${color}` })] : [];
  const told = number === null ? [] : [element("span", { className: "dim", textContent: count(number) })];
  return element("button", { className: "chip", title: hint, "aria-pressed": String(on), onclick: press }, ...dot, words, ...told);
}

function drawChips() {
  const box = byId("chips"), lines = [];
  for (const name of FILTERS) {
    const now = state.chosen[name] || [];
    const counted = runs.counts(now.length ? runs.fitting(filterState(name)) : fits, name);
    const most = allChips.has(name) ? ALL_CHIPS : MAX_CHIPS;
    const values = counted.slice(0, most);
    for (const value of now) if (!values.some(([other]) => other === value)) values.push([value, 0]);
    if (values.length < 2 && !now.length && name !== "outcome" && name !== "labels") continue;
    if (!values.length) continue;
    const more = counted.length > MAX_CHIPS ? [element("button", { className: "chip", title: `More of ${title(name)}`,
      textContent: allChips.has(name) ? "fewer" : `${count(counted.length - MAX_CHIPS)} more …`,
      onclick: () => { if (!allChips.delete(name)) allChips.add(name); soon(); } })] : [];
    lines.push(element("div", { className: "chips", "data-filter": name }, element("span", { className: "kind", textContent: title(name) }), ...values.map(([value, number]) =>
      chip(short(value), number, now.includes(value), () => toggled(name, value), `${title(name)}: ${value || "none"}`,
        name === "outcome" ? SETTINGS.colors[value] : null)), ...more));
  }
  if (runs.pageRuns && runs.others) {
    lines[0].append(chip(state.pages ? "page runs" : "show page runs", runs.pageRuns, state.pages, () => change({ pages: !state.pages }),
      "Runs that pages made by themselves and that have no label"));
  }
  const brushes = [];
  for (const [name, brushed] of Object.entries(state.ranges)) {
    brushes.push(chip(`${title(name)}: ${shownRange(name, brushed)} ✕`, null, true, () => {
      const { [name]: gone, ...rest } = state.ranges;
      change({ ranges: rest });
    }, "Take this brush away"));
  }
  if (state.lasso) brushes.push(chip("lasso ✕", null, true, () => change({ lasso: null }), "Take the lasso away"));
  if (state.only) brushes.push(chip(`a set of ${plural(state.only.length, "run")} ✕`, null, true, () => change({ only: null }), "List all runs again"));
  if (brushes.length || Object.values(state.chosen).some((values) => values.length) || state.search) {
    brushes.push(element("button", { className: "chip", id: "clear", textContent: "Clear all filters", onclick: clearFilters }));
    lines.push(element("div", { className: "chips" }, ...brushes));
  }
  box.replaceChildren(...lines);
}

function clearFilters() { change({ chosen: {}, ranges: {}, lasso: null, only: null, search: "" }); }

// --- groups --------------------------------------------------------------------------------------------------------

function drawMatrix() {
  const open = filterState(state.rows);
  open.chosen = { ...open.chosen, [state.across]: [] };
  const shownFits = runs.fitting(open);
  const a = runs.texts[state.rows], b = runs.texts[state.across];
  const rows = runs.counts(shownFits, state.rows).slice(0, 14);
  const across = state.rows === state.across ? [] : runs.counts(shownFits, state.across).slice(0, MAX_GROUP_COLUMNS);
  const at = runs.crossed(shownFits, state.rows, state.across);
  const codeOf = (column, value) => column.values.indexOf(value);
  const most = Math.max(1, ...rows.flatMap(([value]) => across.map(([other]) => at(codeOf(a, value), codeOf(b, other)))));
  const pressed = (name, value) => (state.chosen[name] || []).includes(value);
  const head = element("tr", {}, element("th"), element("th", { textContent: "all" }), ...across.map(([other]) =>
    element("th", { textContent: short(other), title: other || "none" })));
  const body = [];
  for (const [value, number] of rows) {
    const cells = across.map(([other]) => {
      const cell = at(codeOf(a, value), codeOf(b, other));
      if (!cell) return element("td");
      const on = pressed(state.rows, value) && pressed(state.across, other);
      return element("td", {}, element("button", {
        textContent: count(cell), title: `${value || "none"} in ${other || "none"}`, "aria-pressed": String(on),
        style: `background:color-mix(in srgb, ${SETTINGS.accent} ${Math.round(8 + 62 * Math.sqrt(cell / most))}%, transparent)`,
        onclick: () => change({ chosen: on ? { ...state.chosen, [state.rows]: [], [state.across]: [] }
          : { ...state.chosen, [state.rows]: [value], [state.across]: [other] } }),
      }));
    });
    const isOpen = unfolded.has(value);
    body.push(element("tr", { "data-group": value },
      element("th", {}, element("button", {
        className: "fold", textContent: isOpen ? "▾" : "▸", "aria-expanded": String(isOpen), title: "Show example pictures",
        onclick: () => { if (isOpen) unfolded.delete(value); else unfolded.add(value); soon(); },
      }), element("button", { textContent: value || "none", title: `List only: ${value || "none"}`,
        style: `max-width:${across.length > 3 ? 8.6 : 13}em`,
        "aria-pressed": String(pressed(state.rows, value)), onclick: () => toggled(state.rows, value) })),
      element("td", { textContent: count(number) }), ...cells));
    if (isOpen) body.push(element("tr", { className: "examples" }, element("td", { colSpan: 2 + across.length }, ...examples(a, codeOf(a, value), shownFits))));
  }
  byId("matrix").replaceChildren(element("table", {}, element("thead", {}, head), element("tbody", {}, ...body)));
}

function short(text) { return text ? text.replace(/\.toml$/, "") : "none"; }

// Pictures of runs of a group, each of another scene as long as there are others.
function examples(column, code, shownFits) {
  const found = [], spare = [], scenes = new Set(), scene = runs.texts.scene.codes;
  for (let i = runs.count - 1; i >= 0 && found.length < EXAMPLES; i--) {
    if (!shownFits[i] || column.codes[i] !== code) continue;
    if (scenes.has(scene[i])) { if (spare.length < EXAMPLES) spare.push(i); continue; }
    scenes.add(scene[i]);
    found.push(i);
  }
  return [...found, ...spare].slice(0, EXAMPLES).map((i) => element("button", {
    title: `${runs.value("scene", i)}, ${runs.value("estimator", i)}`, onclick: () => choose(i),
  }, element("img", { src: picture(i), alt: runs.value("scene", i), loading: "lazy" })));
}

const picture = (i) => `/desk/picture?run=${encodeURIComponent(runs.files[i])}`;

// --- plots ---------------------------------------------------------------------------------------------------------

function axis(name) {
  if (!axes.has(name)) axes.set(name, new Axis(runs, name));
  return axes.get(name);
}

let scatter, map, parallel;

function makePlots() {
  scatter = new Points(byId("scatter"), true, (path) => {
    const { [state.x]: x, [state.y]: y, ...rest } = state.ranges;
    if (!path) { change({ ranges: rest }); return; }
    const [from, to] = [path[0], path[path.length - 1]];
    const range = (name, k) => axis(name).range(from[k], to[k]);
    change({ ranges: { ...rest, [state.x]: range(state.x, 0), ...(state.x === state.y ? {} : { [state.y]: range(state.y, 1) }) } });
  }, false);
  map = new Points(byId("map"), false, (path) => {
    const every = path ? Math.max(1, Math.ceil(path.length / 200)) : 1;
    const thin = path && path.filter((_, k) => k % every === 0);
    change({ lasso: thin && thin.map(([u, v]) => [axis("map_x").at(u), axis("map_y").at(v)]) });
  }, true);
  parallel = new Parallel(byId("parallel"), (name, range) => {
    const { [name]: gone, ...rest } = state.ranges;
    change({ ranges: range ? { ...rest, [name]: range } : rest });
  });
  scatter.redrawn = map.redrawn = parallel.redrawn = () => requestAnimationFrame(drawPlots);
}

function drawPlots() {
  const x = axis(state.x), y = axis(state.y);
  const { [state.x]: rx, [state.y]: ry } = state.ranges;
  const [across, up] = [rx ? x.span(rx) : [0, 1], ry ? y.span(ry) : [0, 1]];
  const box = rx || ry ? [[across[0], up[0]], [across[1], up[1]]] : null;
  scatter.draw(x, y, fits, colors, outcomeCodes, chosen, box);
  const mx = axis("map_x"), my = axis("map_y");
  map.draw(mx, my, fits, colors, outcomeCodes, chosen, state.lasso && state.lasso.map(([u, v]) => [mx.place(u), my.place(v)]));
  const every = parallel.draw(AXES.map(axis), listed, hexes, outcomeCodes, state.ranges, AXES.map(title));
  byId("plot-words").textContent = "Drag a box to list only the runs in it; click to take it away." +
    (x.strip || y.strip ? ` ${STRIP_WORDS}` : "");
  byId("parallel-words").textContent = "Drag along an axis to brush." + (every > 1 ? ` One line in ${every} is drawn.` : "");
}

function select(id, names, name) {
  const box = byId(id);
  box.replaceChildren(...names.map((other) => element("option", { value: other, textContent: title(other) })));
  box.value = state[name];
  box.onchange = () => change({ [name]: box.value });
}

// --- table ---------------------------------------------------------------------------------------------------------

// The columns share the room that is left, each by its own width.
const width = (name) => WIDTHS[name] || 90;
const room = (name) => `flex:${width(name)} 0 ${width(name)}px;min-width:0`;

function drawHead() {
  const cells = state.columns.map((name) => element("button", {
    className: runs.isNumber(name) && name !== "created" ? "number" : "", style: room(name), title: `${SETTINGS.columns[name][1]}. Sort by it.`,
    textContent: title(name) + (state.sort === name ? (state.descending ? " ↓" : " ↑") : ""), role: "columnheader",
    "aria-sort": state.sort === name ? (state.descending ? "descending" : "ascending") : "none",
    onclick: () => change({ sort: name, descending: state.sort === name ? !state.descending : runs.isNumber(name) }),
  }));
  byId("table").style.setProperty("--columns", `${state.columns.reduce((sum, name) => sum + width(name), MARK_AND_PICTURE_PX)}px`);
  byId("head").replaceChildren(element("span", { className: "mark", role: "columnheader", "aria-label": "Marked" }),
    element("span", { className: "picture", role: "columnheader", "aria-label": "Picture" }), ...cells);
}

function drawRows() {
  const table = byId("table"), body = byId("body");
  body.style.height = `${listed.length * ROW_PX}px`;
  const first = Math.max(0, Math.floor(table.scrollTop / ROW_PX) - 4);
  const last = Math.min(listed.length, first + Math.ceil(table.clientHeight / ROW_PX) + 8);
  const rows = [];
  for (let at = first; at < last; at++) rows.push(row(listed[at]));
  const box = byId("rows");
  box.style.transform = `translateY(${first * ROW_PX}px)`;
  box.replaceChildren(...rows);
  if (!listed.length) box.replaceChildren(element("p", { className: "dim", style: "padding:1em", textContent: runs.count ? "No run fits these filters." : "No run is recorded yet." }));
}

function row(i) {
  const cells = state.columns.map((name) => {
    const value = runs.value(name, i), isNumber = typeof value === "number" && name !== "created";
    const cell = element("span", { className: isNumber ? "number" : "", style: room(name), role: "gridcell" });
    if (name === "labels") for (const label of runs.labels[i]) cell.append(element("span", { className: "label", textContent: label }));
    else if (name === "outcome") cell.append(element("span", { className: "dot", style: `background:${SETTINGS.colors[value]}` }), value);
    else cell.textContent = shown(name, name === "scene" ? short(value) : value) + (runs.saysUnit(name, i) ? " units" : "");
    if (!isNumber) cell.title = cell.textContent;
    return cell;
  });
  const isMarked = marked.has(i);
  return element("div", { className: `row${isMarked ? " marked" : ""}${i === chosen ? " chosen" : ""}`, role: "row", "data-file": runs.files[i],
    "aria-selected": String(i === chosen), onclick: (event) => clicked(i, event), ondblclick: () => open(i) },
  element("span", { className: "mark", role: "gridcell", onclick: (event) => { event.stopPropagation(); mark(i); } },
    element("span", { role: "checkbox", "aria-checked": String(isMarked), "aria-label": "Mark", textContent: isMarked ? "☑" : "☐" })),
  element("span", { className: "picture", role: "gridcell" }, element("img", { src: picture(i), alt: "", loading: "lazy" })), ...cells);
}

function clicked(i, event) {
  if (event.shiftKey && anchor >= 0) {
    const [a, b] = [listed.indexOf(anchor), listed.indexOf(i)].sort((p, q) => p - q);
    for (let at = Math.max(0, a); at <= b; at++) marked.add(listed[at]);
  } else if (event.ctrlKey || event.metaKey) { mark(i); return; }
  else anchor = i;
  choose(i);
}

function mark(i) {
  if (marked.has(i)) marked.delete(i); else marked.add(i);
  anchor = i;
  soon();
}

function drawTools() {
  // The side of the chosen run takes no room before there is one.
  document.body.classList.toggle("unchosen", chosen < 0);
  const hint = chosen < 0 && listed.length ? "Choose a run: click a row, or press ↓." : "";
  byId("listed").textContent = marked.size ? `${plural(marked.size, "run")} marked` : hint;
  byId("mark-all").textContent = `Mark all ${count(listed.length)} listed`;
  byId("mark-all").disabled = !listed.length;
  byId("mark-none").hidden = !marked.size;
  byId("undo").disabled = !reviews.steps.length;
}

function choose(i, scroll = false) {
  chosen = i;
  if (scroll) {
    const table = byId("table"), at = listed.indexOf(i), top = at * ROW_PX;
    const head = byId("head").offsetHeight;
    if (top < table.scrollTop) table.scrollTop = top;
    if (top + ROW_PX > table.scrollTop + table.clientHeight - head) table.scrollTop = top + ROW_PX - table.clientHeight + head;
  }
  soon();
  showRun(i);
}

function step(by) {
  if (!listed.length) return;
  const at = listed.indexOf(chosen);
  choose(listed[at < 0 ? 0 : Math.min(listed.length - 1, Math.max(0, at + by))], true);
}

// --- the chosen run ------------------------------------------------------------------------------------------------

let details = null;

async function showRun(i) {
  const file = runs.files[i], panel = byId("right");
  let told;
  try { told = await asked(`/desk/run?run=${encodeURIComponent(file)}`); }
  catch (error) { say(error.message, true); return; }
  if (chosen !== i) return;
  details = told;
  const evidence = element("ul", { id: "evidence" }, element("li", { className: "dim", textContent: "Reading the evidence …" }));
  const advice = element("p", { id: "advice" });
  panel.replaceChildren(
    element("img", { className: "large", src: picture(i), alt: "Picture of the run", onerror: (event) => { event.target.hidden = true; } }),
    element("h2", { textContent: told.title }),
    element("p", {}, element("span", { className: "dot", style: `background:${SETTINGS.colors[told.outcome]}` }),
      element("b", { textContent: told.outcome }), told.diagnosis && told.diagnosis !== "ok" ? `: ${told.diagnosis}` : ""),
    element("p", { textContent: told.summary }), evidence, advice,
    element("div", { className: "actions" },
      element("a", { className: "first", href: pageLink(file), target: "_blank", rel: "noopener", textContent: `Open at step ${told.step}`, title: "In the playground ( Enter )" }),
      element("a", { href: told.viewer, target: "_blank", rel: "noopener", textContent: `Rerun, step ${told.step} of ${told.steps}`, title: "In Rerun's viewer ( r )" })),
    element("h2", { textContent: "Labels" }), element("div", { id: "label-keys" }),
    element("h2", { textContent: "Note" }),
    element("textarea", { id: "note", value: told.note, "aria-label": "Note", onchange: (event) => {
      const note = event.target.value;
      reviews.change(() => ({ changes: [{ file, add: [], remove: [], note }], words: "Note stored." }));
    } }),
    element("h2", { textContent: "Run" }),
    element("ul", {}, ...told.facts.map((fact) => element("li", { textContent: fact }))),
    element("p", { className: "dim", textContent: Object.entries(told.options).map(([name, value]) => `${name} ${value}`).join(", ") }),
    element("p", {}, element("code", { textContent: `spherloc run ${told.path}` })));
  drawLabelKeys();
  try {
    const more = await asked(`/desk/evidence?run=${encodeURIComponent(file)}`);
    evidence.replaceChildren(...more.evidence.map((sentence) => element("li", { textContent: sentence })));
    advice.replaceChildren(element("b", { textContent: more.advice }));
  } catch (error) { evidence.replaceChildren(element("li", { textContent: error.message })); }
}

const pageLink = (file) => `/#v=1&run=${encodeURIComponent(file)}`;

function drawLabelKeys() {
  const box = byId("label-keys");
  if (!box || chosen < 0) return;
  const own = runs.labels[chosen];
  const lines = state.keys.map((label, k) => element("div", { className: "keys-row" },
    element("button", { textContent: k + 1, "aria-pressed": String(own.includes(label)), title: `Label “${label}” ( ${k + 1} )`, onclick: () => labelWith(label) }),
    element("input", { className: "key", value: label, "aria-label": `Label of key ${k + 1}`, maxLength: 40, onchange: (event) => {
      const words = event.target.value.trim();
      if (words) change({ keys: state.keys.map((other, at) => (at === k ? words : other)) }, false);
      drawLabelKeys();
    } })));
  const others = own.filter((label) => !state.keys.includes(label));
  const chips = others.map((label) => element("button", { className: "chip", textContent: `${label} ✕`, title: "Take this label away", onclick: () => labelWith(label) }));
  box.replaceChildren(...lines, element("div", { className: "chips" }, ...chips));
}

const targets = () => (marked.size ? [...marked] : chosen >= 0 ? [chosen] : []);

// All of them get the label, unless all have it: then it is taken away.
function labelWith(label) {
  const which = targets();
  if (!which.length) { say("Choose or mark runs first."); return; }
  const files = which.map((i) => runs.files[i]);
  reviews.change(() => {
    const has = (file) => runs.index.has(file) && runs.labels[runs.index.get(file)].includes(label);
    const all = files.every(has);
    const changes = files.filter((file) => has(file) === all)
      .map((file) => ({ file, add: all ? [] : [label], remove: all ? [label] : [], note: null }));
    return { changes, words: `${all ? "Removed" : "Labelled"} “${label}”: ${plural(changes.length, "run")}.` };
  });
}

function seen() {
  const files = targets().map((i) => runs.files[i]);
  reviews.change(() => {
    const changes = files.filter((file) => runs.index.has(file) && !runs.labels[runs.index.get(file)].includes(SEEN))
      .map((file) => ({ file, add: [SEEN], remove: [], note: null }));
    return { changes, words: `Seen: ${plural(changes.length, "run")}.` };
  });
  if (!marked.size) step(1);
}

function open(i) { window.open(pageLink(runs.files[i]), "_blank", "noopener"); }

// --- views, sets, columns ------------------------------------------------------------------------------------------

// Below the form for a new name, which is made once: what is being typed there stays, and so does the cursor.
function drawMenu(id, words, act, lines) {
  const box = byId(id);
  if (!box.firstChild) {
    const input = element("input", { maxLength: 60 });
    box.append(element("form", { className: "entry", onsubmit: (event) => {
      event.preventDefault();
      const name = input.value.trim();
      input.value = "";
      if (name) act(name);
    } }, input, element("button", { textContent: "Save" })), element("div"));
  }
  const input = box.querySelector("input");
  input.placeholder = input.ariaLabel = words;
  box.lastChild.replaceChildren(...lines);
}

function drawSaved() {
  const views = Object.entries(saved.views).map(([name, view]) => element("div", { className: "entry" },
    element("button", { textContent: name, onclick: () => { change(readState(encodeURIComponent(JSON.stringify(view)))); byId("views-menu").open = false; } }),
    element("button", { textContent: "✕", title: `Delete the view ${name}`, onclick: () => act({ do: "delete_view", name }) })));
  drawMenu("views", "Name of this view", saveView, [...views,
    element("p", { className: "dim", textContent: "The address of this page is a link to what it lists." })]);
  const sets = Object.entries(saved.sets).map(([name, size]) => element("div", { className: "entry" },
    element("span", { className: "grow", textContent: `${name}: ${plural(size, "run")}` })));
  drawMenu("sets", marked.size ? `Name for ${plural(marked.size, "marked run")}` : `Name for ${plural(listed.length, "listed run")}`, saveSet, [...sets,
    element("p", { className: "dim", textContent: "A set can be compared here, and run again by spherloc rerun." })]);
}

function saveView(name) {
  const view = JSON.parse(decodeURIComponent(stateText() || "%7B%7D"));
  act({ do: "save_view", name, state: view }, `View “${name}” is stored.`);
}

async function saveSet(name) {
  const told = await act({ do: "save_set", name, files: filesToSend() });
  if (told) say(`${plural(told.runs, "run")} stored. Run them again with: spherloc rerun "${told.path}" --estimator mc-exact`);
}

async function act(what, words = "") {
  try {
    const told = await done(what);
    if (told.views) saved.views = told.views;
    if (told.sets) saved.sets = told.sets;
    drawSaved();
    if (words) say(words);
    return told;
  } catch (error) { say(error.message, true); return null; }
}

const filesToSend = () => (marked.size ? [...marked] : [...listed]).map((i) => runs.files[i]);

function drawColumns() {
  byId("columns").replaceChildren(...Object.keys(SETTINGS.columns).map((name) => element("label", { title: SETTINGS.columns[name][1] },
    element("input", { type: "checkbox", checked: state.columns.includes(name), onchange: (event) => {
      change({ columns: event.target.checked ? [...state.columns, name] : state.columns.filter((other) => other !== name) }, false);
    } }), ` ${title(name)}`)));
}

// --- compare and report --------------------------------------------------------------------------------------------

function sides() {
  const labels = runs.counts(new Uint8Array(runs.count).fill(1), "labels").map(([label]) => ["label", label]);
  const estimators = runs.texts.estimator.values.map((name) => ["estimator", name]);
  const sets = Object.keys(saved.sets).map((name) => ["set", name]);
  const now = [["listed", `the ${plural(listed.length, "listed run")}`], ...(marked.size ? [["marked", `the ${plural(marked.size, "marked run")}`]] : [])];
  const folders = saved.folders.map(({ place, name }) => ["folder", place, name]);
  return [...now, ...sets, ...labels, ...folders, ...estimators];
}

function sideOf(text) {
  const [kind, name, words] = JSON.parse(text);
  if (kind === "set") return [{ set: name }, `set ${name}`];
  if (kind === "folder") return [{ folder: name }, `folder ${words}`];
  const all = Array.from({ length: runs.count }, (_, i) => i);
  const which = kind === "label" ? all.filter((i) => runs.labels[i].includes(name))
    : kind === "estimator" ? [...listed].filter((i) => runs.value("estimator", i) === name)
      : kind === "marked" ? [...marked] : [...listed];
  return [{ files: which.map((i) => runs.files[i]) }, kind === "label" ? `label ${name}` : kind === "estimator" ? `${name}, of the listed runs` : name];
}

async function openCompare() {
  byId("compared").replaceChildren();
  byId("compare-dialog").showModal();
  try { saved.folders = (await asked("/desk/folders")).folders; }
  catch (error) { byId("compared").textContent = error.message; }
  for (const id of ["before", "after"]) {
    byId(id).replaceChildren(...sides().map((side) => element("option", { value: JSON.stringify(side), textContent: side[0] === "listed" || side[0] === "marked" ? side[1] : `${side[0]} ${side[2] || side[1]}` })));
  }
  // Another night lies in another folder; without one two sets of this desk are compared.
  const folder = sides().findIndex(([kind]) => kind === "folder");
  byId("before").selectedIndex = Math.max(0, folder);
  byId("after").selectedIndex = folder >= 0 ? 0 : Math.min(1, byId("after").options.length - 1);
}

async function doCompare() {
  const box = byId("compared");
  if (byId("before").value === byId("after").value) { box.textContent = "Both are the same set: choose another one."; return; }
  box.textContent = "Comparing …";
  const [before, beforeName] = sideOf(byId("before").value), [after, afterName] = sideOf(byId("after").value);
  const side = (which, name) => (which.files ? { [name]: which.files }
    : which.set ? { [`${name}_set`]: which.set } : { [`${name}_folder`]: which.folder });
  try {
    const told = await done({ do: "compare", ...side(before, "before"), ...side(after, "after"), before_name: beforeName, after_name: afterName });
    const share = (right) => (told.judged ? `${count(right)} of ${count(told.judged)} (${((100 * right) / told.judged).toFixed(1)} %)` : "none can be judged");
    const here = after.folder ? 0 : 1; // which run of a pair is on this desk
    const only = (pairs, words) => element("button", { textContent: `List the ${count(pairs.length)} ${words}`,
      disabled: !pairs.length || Boolean(before.folder && after.folder), onclick: () => {
        byId("compare-dialog").close();
        change({ chosen: {}, ranges: {}, lasso: null, search: "", only: pairs.map((pair) => pair[here]) });
      } });
    box.replaceChildren(
      element("p", {}, element("b", { id: "verdict", textContent: `${plural(told.broken.length, "new failure")}, ${count(told.mended.length)} mended` }),
        ` of ${plural(told.pairs, "pair")}; McNemar's exact test: p = ${told.p}`),
      element("p", { textContent: `Right before: ${share(told.rightBefore)}; right after: ${share(told.rightAfter)}. Without a partner: ${count(told.onlyBefore)} before, ${count(told.onlyAfter)} after.` }),
      element("table", {}, element("tr", {}, ...["", "median before", "median after", "median difference", "p (Wilcoxon)"].map((head) => element("th", { textContent: head }))),
        ...told.changes.map((line) => element("tr", {}, ...line.map((cell) => element("td", { textContent: cell }))))),
      element("p", { textContent: told.brokenCauses.length ? `New failures by cause: ${told.brokenCauses.map(([cause, number]) => `${cause} ${number}`).join(", ")}.` : "" }),
      element("p", {}, only(told.broken, "new failures"), " ", only(told.mended, "mended"), " ",
        element("a", { href: told.address, download: told.name, textContent: "Save the report (HTML with pictures)" })));
  } catch (error) { box.textContent = error.message; }
}

async function report() {
  say("Writing the report …");
  const told = await act({ do: "report", files: filesToSend() });
  if (!told) return;
  const news = byId("news");
  news.replaceChildren(`Report of ${plural(told.runs, "run")}: `, element("a", { href: told.address, download: told.name, textContent: told.name }));
  news.querySelector("a").click();
}

// --- keys ----------------------------------------------------------------------------------------------------------

function escaped() {
  if (marked.size) { marked.clear(); soon(); return; }
  if (Object.keys(state.ranges).length || state.lasso) { change({ ranges: {}, lasso: null }); return; }
  clearFilters();
}

const KEYS = {
  ArrowDown: () => step(1), ArrowUp: () => step(-1), j: () => step(1), k: () => step(-1), s: seen, u: () => reviews.undo(),
  x: () => { if (chosen >= 0) mark(chosen); }, a: () => { for (const i of listed) marked.add(i); soon(); }, Escape: escaped,
  n: () => byId("note") && byId("note").focus(), Enter: () => { if (chosen >= 0) open(chosen); },
  r: () => { if (details) window.open(details.viewer, "_blank", "noopener"); },
  "/": () => byId("search").focus(), "?": () => byId("keys-dialog").showModal(),
};

document.addEventListener("keydown", (event) => {
  const typing = event.target.matches("input:not([type=checkbox]), textarea, select");
  if (typing) { if (event.key === "Escape") event.target.blur(); return; }
  if (document.querySelector("dialog[open]") || event.altKey) return;
  if ((event.ctrlKey || event.metaKey) && event.key !== "z") return;
  if (event.target.matches("button, summary, a") && (event.key === "Enter" || event.key === " ")) return;
  const press = event.ctrlKey || event.metaKey ? KEYS.u : /^[1-9]$/.test(event.key) ? () => labelWith(state.keys[event.key - 1]) : KEYS[event.key];
  if (!press || !runs) return;
  event.preventDefault();
  press();
});

// --- start ---------------------------------------------------------------------------------------------------------

const POLL_MS = 5000;

async function load() {
  const told = await asked("/desk/runs");
  const open = chosen >= 0 ? runs.files[chosen] : null, marks = [...marked].map((i) => runs.files[i]);
  runs = new Runs(told);
  axes.clear();
  marked.clear();
  for (const file of marks) if (runs.index.has(file)) marked.add(runs.index.get(file));
  chosen = open !== null && runs.index.has(open) ? runs.index.get(open) : -1;
  outcomeCodes = runs.texts.outcome.codes;
  hexes.splice(0, hexes.length, ...runs.texts.outcome.values.map((outcome) => SETTINGS.colors[outcome]));
  colors.splice(0, colors.length, ...hexes.map(rgb));
  const [across, up] = runs.axes.map((words) => SETTINGS.measures.reduce((text, name) => text.replace(name, title(name)), words));
  byId("map-words").textContent = across
    ? `Runs with like evidence lie near each other (principal components; → ${across}; ↑ ${up}). Draw around some to list them.`
    : runs.count < 2 ? "A map is made of two runs or more."
      : "These runs have no measured evidence: they were recorded by an older version.";
}

async function poll() {
  if (!document.hidden) await reviews.between(refresh);
  setTimeout(poll, POLL_MS);
}

async function refresh() {
  const { version } = await asked("/desk/version");
  if (version === runs.version) return;
  await load();
  reviews.runs = runs;
  update();
}

async function start() {
  try {
    await load();
    saved = { ...saved, ...await asked("/desk/saved") };
  } catch (error) { byId("counts").textContent = ""; say(error.message, true); return; }
  reviews = new Reviews(runs, () => { update(); drawLabelKeys(); }, say);
  state = readState(location.hash.slice(1));
  const numbers = Object.keys(SETTINGS.columns).filter((name) => runs.isNumber(name));
  const selects = () => {
    select("plot-x", numbers, "x"); select("plot-y", numbers, "y");
    select("rows-by", GROUPED, "rows"); select("columns-by", GROUPED, "across");
  };
  selects();
  makePlots(); drawColumns(); drawSaved();
  window.addEventListener("popstate", () => { state = readState(location.hash.slice(1)); selects(); drawColumns(); update(); });
  window.addEventListener("resize", soon);
  byId("table").addEventListener("scroll", () => requestAnimationFrame(drawRows));
  byId("search").addEventListener("input", (event) => change({ search: event.target.value.slice(0, 200) }, false));
  byId("mark-all").onclick = () => KEYS.a();
  byId("mark-none").onclick = () => { marked.clear(); soon(); };
  byId("undo").onclick = () => reviews.undo();
  byId("report").onclick = report;
  byId("compare-open").onclick = openCompare;
  byId("compare-do").onclick = doCompare;
  byId("keys-open").onclick = () => byId("keys-dialog").showModal();
  for (const menu of document.querySelectorAll("details.menu")) menu.addEventListener("toggle", () => { if (menu.open) { drawSaved(); drawColumns(); } });
  document.addEventListener("click", (event) => {
    for (const menu of document.querySelectorAll("details.menu[open]")) if (!menu.contains(event.target)) menu.open = false;
  });
  update();
  document.body.dataset.state = "open";
  setTimeout(poll, POLL_MS);
}

start();
