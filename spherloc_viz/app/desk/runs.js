"use strict";
// All runs of the folder as columns: which of them fit the filters, in what order, and how many there are of each kind.

const LENGTHS = ["translation_error_m", "position_sd_m"];
const NOTHING = [1, 0]; // a range without known values

class Runs {
  constructor(told) {
    this.version = told.version;
    this.files = told.files;
    this.count = told.files.length;
    this.texts = told.texts;
    for (const column of Object.values(told.texts)) column.codes = Int32Array.from(column.codes);
    this.labels = told.labels.codes.map((code) => told.labels.values[code]);
    const lists = new Map(told.labels.values.map((text) => [text, JSON.parse(text || "[]")]));
    this.labels = this.labels.map((text) => lists.get(text));
    this.notes = new Map(Object.entries(told.notes));
    this.numbers = {};
    for (const [name, values] of Object.entries(told.numbers)) {
      this.numbers[name] = Float64Array.from(values, (value) => (value === null ? NaN : value));
    }
    this.axes = told.axes;
    this.fromPages = new Uint8Array(this.count);
    this.findPageRuns();
    const units = new Set(Array.from(told.texts.units.codes, (code) => told.texts.units.values[code]));
    this.unit = ["m", "units"].filter((unit) => units.has(unit)).join(" or ") || "m";
    this.index = new Map(told.files.map((file, i) => [file, i]));
    this.orders = new Map(); // by column: all runs in its order, unknown ones last
  }

  // Runs that pages made by themselves and that have no label.
  findPageRuns() {
    const { values, codes } = this.texts.source, code = values.indexOf("page");
    this.pageRuns = 0;
    this.others = codes.some((other) => other !== code); // else runs of pages are all that there is, and are listed
    for (let i = 0; i < this.count; i++) this.pageRuns += this.fromPages[i] = Number(codes[i] === code && !this.labels[i].length);
  }

  // Whether a length must say that it is not in metres, since others in its column are.
  saysUnit(name, i) {
    const isLength = LENGTHS.includes(name) && Number.isFinite(this.value(name, i));
    return isLength && this.unit.includes(" ") && this.value("units", i) === "units";
  }
  isNumber(name) { return name in this.numbers; }
  has(name) { return name in this.numbers || name in this.texts || name === "labels" || name === "file"; }

  value(name, i) {
    if (name === "labels") return this.labels[i].join(", ");
    if (name === "file") return this.files[i];
    if (name in this.numbers) return this.numbers[name][i];
    const column = this.texts[name];
    return column.values[column.codes[i]];
  }

  // 1 for every run that fits all filters of the state.
  fitting(state, lasso = true) {
    const fits = new Uint8Array(this.count).fill(1);
    const apart = !state.pages && this.others && !(state.chosen.source || []).includes("page");
    if (apart) for (let i = 0; i < this.count; i++) fits[i] = 1 - this.fromPages[i];
    for (const [name, chosen] of Object.entries(state.chosen)) if (chosen.length) this.keepChosen(fits, name, chosen);
    for (const [name, range] of Object.entries(state.ranges)) if (this.numbers[name]) this.keepRange(fits, this.numbers[name], range);
    if (state.only) {
      const wanted = new Uint8Array(this.count);
      for (const file of state.only) if (this.index.has(file)) wanted[this.index.get(file)] = 1;
      for (let i = 0; i < this.count; i++) fits[i] &= wanted[i];
    }
    for (const word of state.search.toLowerCase().split(/\s+/).filter(Boolean)) this.keepWord(fits, word);
    if (lasso && state.lasso) this.keepLasso(fits, state.lasso);
    return fits;
  }

  keepChosen(fits, name, chosen) {
    if (name === "labels") {
      for (let i = 0; i < this.count; i++) {
        if (!chosen.some((label) => (label === "" ? !this.labels[i].length : this.labels[i].includes(label)))) fits[i] = 0;
      }
      return;
    }
    if (!this.texts[name]) return;
    const { values, codes } = this.texts[name];
    const wanted = Uint8Array.from(values, (value) => (chosen.includes(value) ? 1 : 0));
    for (let i = 0; i < this.count; i++) fits[i] &= wanted[codes[i]];
  }

  keepRange(fits, values, [low, high, unknown]) {
    for (let i = 0; i < this.count; i++) {
      if (!(values[i] >= low && values[i] <= high) && !(unknown && Number.isNaN(values[i]))) fits[i] = 0;
    }
  }

  keepWord(fits, word) {
    const columns = Object.values(this.texts).map((column) =>
      [column.codes, Uint8Array.from(column.values, (value) => (value.toLowerCase().includes(word) ? 1 : 0))]);
    const useful = columns.filter(([, found]) => found.includes(1));
    for (let i = 0; i < this.count; i++) {
      if (!fits[i]) continue;
      let found = 0;
      for (const [codes, wanted] of useful) found |= wanted[codes[i]];
      if (found || this.labels[i].some((label) => label.toLowerCase().includes(word))) continue;
      if (this.files[i].toLowerCase().includes(word)) continue;
      if ((this.notes.get(this.files[i]) || "").toLowerCase().includes(word)) continue;
      fits[i] = 0;
    }
  }

  keepLasso(fits, polygon) {
    const x = this.numbers.map_x, y = this.numbers.map_y;
    for (let i = 0; i < this.count; i++) if (fits[i] && !inside(polygon, x[i], y[i])) fits[i] = 0;
  }

  // The runs that fit, in the order of a column; those without a value come last both ways.
  listed(fits, name, descending) {
    const order = this.order(name);
    let total = 0;
    for (let i = 0; i < this.count; i++) total += fits[i];
    const found = new Int32Array(total);
    let at = 0;
    const { runs, known } = order;
    if (descending) for (let k = known - 1; k >= 0; k--) { if (fits[runs[k]]) found[at++] = runs[k]; }
    else for (let k = 0; k < known; k++) if (fits[runs[k]]) found[at++] = runs[k];
    for (let k = known; k < runs.length; k++) if (fits[runs[k]]) found[at++] = runs[k];
    return found;
  }

  order(name) {
    if (this.orders.has(name)) return this.orders.get(name);
    let keys;
    if (name in this.numbers) keys = this.numbers[name];
    else if (name in this.texts) {
      const { values, codes } = this.texts[name];
      const ranks = new Float64Array(values.length);
      values.map((value, code) => code).sort((a, b) => (values[a] < values[b] ? -1 : values[a] > values[b] ? 1 : 0))
        .forEach((code, rank) => { ranks[code] = values[code] === "" ? NaN : rank; });
      keys = Float64Array.from(codes, (code) => ranks[code]);
    } else {
      const texts = Array.from({ length: this.count }, (_, i) => this.value(name, i));
      const distinct = [...new Set(texts)].sort();
      const ranks = new Map(distinct.map((text, rank) => [text, text === "" ? NaN : rank]));
      keys = Float64Array.from(texts, (text) => ranks.get(text));
    }
    const known = [], unknown = [];
    for (let i = 0; i < this.count; i++) (Number.isNaN(keys[i]) ? unknown : known).push(i);
    const sorted = Int32Array.from(known).sort((a, b) => keys[a] - keys[b] || a - b);
    const order = { runs: Int32Array.from([...sorted, ...unknown]), known: known.length };
    this.orders.set(name, order);
    return order;
  }

  // How many of the runs that fit have each value of a text column, or each label, the most frequent first.
  counts(fits, name) {
    if (name === "labels") {
      const counted = new Map();
      for (let i = 0; i < this.count; i++) {
        if (fits[i]) for (const label of this.labels[i]) counted.set(label, (counted.get(label) || 0) + 1);
      }
      return [...counted].sort((a, b) => b[1] - a[1]);
    }
    const { values, codes } = this.texts[name];
    const counted = new Int32Array(values.length);
    for (let i = 0; i < this.count; i++) counted[codes[i]] += fits[i];
    return values.map((value, code) => [value, counted[code]]).filter(([, count]) => count).sort((a, b) => b[1] - a[1]);
  }

  // How many of the runs that fit have a value of one text column and one of another, by their codes.
  crossed(fits, rows, columns) {
    const a = this.texts[rows], b = this.texts[columns];
    const width = b.values.length;
    const counted = new Int32Array(a.values.length * width);
    for (let i = 0; i < this.count; i++) counted[a.codes[i] * width + b.codes[i]] += fits[i];
    return (value, other) => counted[value * width + other];
  }

  reviewed(file, labels, note) {
    const i = this.index.get(file);
    if (i === undefined) return;
    this.labels[i] = labels;
    if (note) this.notes.set(file, note); else this.notes.delete(file);
    this.orders.delete("labels");
  }
}

function inside(polygon, x, y) {
  let odd = false;
  for (let k = 0, j = polygon.length - 1; k < polygon.length; j = k++) {
    const [xk, yk] = polygon[k], [xj, yj] = polygon[j];
    if ((yk > y) !== (yj > y) && x < ((xj - xk) * (y - yk)) / (yj - yk) + xk) odd = !odd;
  }
  return odd;
}

function shownRange(name, [low, high, unknown]) {
  if (low > high) return "unknown";
  return `${shown(name, low)} to ${shown(name, high)}${unknown ? ", or unknown" : ""}`;
}

function shown(name, value) {
  if (typeof value !== "number") return value === "" ? "–" : value;
  if (Number.isNaN(value)) return "–";
  if (name === "created") return new Date(1000 * value).toLocaleString([], { month: "short", day: "2-digit", hour: "2-digit", minute: "2-digit" });
  if (Number.isInteger(value)) return value.toLocaleString("en");
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(1) : value.toPrecision(3);
}
