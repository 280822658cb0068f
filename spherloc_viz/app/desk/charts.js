"use strict";
// Plots of many runs: points are written into pixels, since 100,000 calls that draw a circle take a second.

const LOG_COLUMNS = new Set(["rotation_error_deg", "translation_error_m", "time_ms", "correspondences", "tilt_deg",
  "rotation_sd_deg", "position_sd_m", "size_bytes"]);
const MARGIN = { left: 46, right: 10, top: 8, bottom: 26 };
const MAX_LINES = 1200;
const AXES = ["outlier_rate", "correspondences", "residual_median", "alternative_support", "coverage", "tilt_deg",
  "rotation_error_deg", "time_ms"];

function rgb(hex) { return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)); }

const STRIP = 0.08; // of an axis, for runs whose value is unknown; known ones have the rest

// Maps the values of a column to 0 to 1. Unknown ones are spread over a strip at the start, where they can be brushed too.
class Axis {
  constructor(runs, name) {
    this.name = name;
    const values = runs.numbers[name];
    let low = Infinity, high = -Infinity, least = Infinity;
    this.strip = 0;
    for (let i = 0; i < values.length; i++) {
      const value = values[i];
      if (Number.isNaN(value)) { this.strip = STRIP; continue; }
      if (value < low) low = value;
      if (value > high) high = value;
      if (value > 0 && value < least) least = value;
    }
    this.log = LOG_COLUMNS.has(name) && high > 0 && high > 20 * least;
    if (this.log) { this.low = Math.log10(Math.max(least, high * 1e-9)); this.high = Math.log10(high); }
    else { this.low = low; this.high = high; }
    if (!(this.high > this.low)) { this.low = (Number.isFinite(this.low) ? this.low : 0) - 0.5; this.high = this.low + 1; }
    const room = 0.03 * (this.high - this.low);
    this.low -= room; this.high += room;
    this.places = new Float32Array(values.length);
    const scale = (1 - this.strip) / (this.high - this.low);
    for (let i = 0; i < values.length; i++) {
      const value = this.log ? Math.log10(Math.max(values[i], 10 ** (this.low + room))) : values[i];
      this.places[i] = Number.isNaN(value) ? this.strip * (0.15 + 0.7 * ((i * 0.618034) % 1)) : this.strip + (value - this.low) * scale;
    }
  }
  at(place) {
    const value = this.low + ((place - this.strip) / (1 - this.strip)) * (this.high - this.low);
    return this.log ? 10 ** value : value;
  }
  place(value) {
    const low = this.low, width = this.high - low;
    return this.strip + ((1 - this.strip) * ((this.log ? Math.log10(Math.max(value, 1e-300)) : value) - low)) / width;
  }
  // What lies between two places: [low, high], and a 1 behind them if it is also what is unknown.
  range(from, to) {
    const [a, b] = [Math.min(from, to), Math.max(from, to)];
    const known = b > this.strip ? [this.at(Math.max(a, this.strip)), this.at(b)] : NOTHING;
    return a < this.strip ? [...known, 1] : known;
  }
  // The places of a range; where only unknown or only known values are in it, it ends with the strip or begins there.
  span([low, high, unknown]) {
    const [a, b] = low <= high ? [this.place(low), this.place(high)] : [0, this.strip];
    return [Math.max(0, unknown ? 0 : a), Math.min(1, b)];
  }
  ticks() {
    const found = [];
    if (this.log) {
      const step = Math.max(1, Math.ceil((this.high - this.low) / 5));
      for (let k = Math.ceil(this.low); k <= this.high; k += step) found.push(10 ** k);
      if (found.length > 1) return found;
      found.length = 0;
    }
    const [low, high] = [this.at(this.strip), this.at(1)];
    const rough = (high - low) / 4, unit = 10 ** Math.floor(Math.log10(rough));
    const step = unit * [1, 2, 5, 10].find((k) => k * unit >= rough);
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) found.push(Math.abs(value) < step / 1e6 ? 0 : value);
    return found;
  }
}

// How much larger a wide window shows the page than its style says.
const zoomOf = (canvas) => canvas.getBoundingClientRect().width / canvas.offsetWidth || 1;

// Where a press is on a canvas, and how large that is, in the pixels of its style.
function pressed(event, canvas) {
  const box = canvas.getBoundingClientRect(), zoom = zoomOf(canvas);
  const inside = [event.clientX - box.left, event.clientY - box.top, box.width, box.height].map((value) => value / zoom);
  return { x: inside[0], y: inside[1], width: inside[2], height: inside[3] };
}

function sized(canvas) {
  const scale = (window.devicePixelRatio || 1) * zoomOf(canvas);
  const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  return scale;
}

function tickText(value) {
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e4 || size < 1e-2)) return value.toExponential(0).replace("e+", "e");
  return String(Number(value.toPrecision(3)));
}

// Two columns against each other. Runs that are not listed are faint; a box or a lasso is drawn with the mouse.
class Points {
  constructor(canvas, axes, brushed, isLasso) {
    this.canvas = canvas; this.withAxes = axes; this.isLasso = isLasso; this.dragged = null;
    this.x = this.y = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.dragged = [this.spot(event)];
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.dragged) return;
      if (isLasso) this.dragged.push(this.spot(event)); else this.dragged[1] = this.spot(event);
      this.redrawn();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (!this.dragged) return;
      const path = [...this.dragged, this.spot(event)];
      this.dragged = null;
      const xs = path.map(([x]) => x), ys = path.map(([, y]) => y);
      const small = Math.max(...xs) - Math.min(...xs) < 0.012 && Math.max(...ys) - Math.min(...ys) < 0.012;
      brushed(small ? null : path);
    });
    this.redrawn = () => {};
  }
  spot(event) {
    const at = pressed(event, this.canvas), edge = this.edge();
    const x = (at.x - edge.left) / (at.width - edge.left - edge.right);
    const y = 1 - (at.y - edge.top) / (at.height - edge.top - edge.bottom);
    return [Math.min(1, Math.max(0, x)), Math.min(1, Math.max(0, y))];
  }
  edge() { return this.withAxes ? MARGIN : { left: 6, right: 6, top: 6, bottom: 6 }; }

  // Axes x and y, 1 for every run that is listed, a color for every code of the runs, the chosen run, and what is brushed.
  draw(x, y, fits, colors, codes, chosen, brush) {
    this.x = x; this.y = y;
    const canvas = this.canvas, scale = sized(canvas), context = canvas.getContext("2d"), edge = this.edge();
    if (!canvas.width || !canvas.height) return;
    const wide = canvas.width / scale - edge.left - edge.right, high = canvas.height / scale - edge.top - edge.bottom;
    context.putImageData(this.points(context, scale, wide, high, fits, colors, codes), 0, 0);
    context.save();
    context.scale(scale, scale);
    context.translate(edge.left, edge.top);
    context.fillStyle = context.strokeStyle = getComputedStyle(document.body).color;
    context.font = "11px system-ui, sans-serif";
    if (this.withAxes) this.drawAxes(context, wide, high);
    if (chosen >= 0) {
      context.beginPath();
      context.arc(x.places[chosen] * wide, (1 - y.places[chosen]) * high, 6, 0, 7);
      context.lineWidth = 2;
      context.stroke();
    }
    const path = this.dragged || brush;
    if (path && path.length > 1) this.drawBrush(context, path.map(([u, v]) => [u * wide, (1 - v) * high]));
    context.restore();
  }

  // Faint points first, those that are listed over them.
  points(context, scale, wide, high, fits, colors, codes) {
    const width = this.canvas.width, edge = this.edge(), left = edge.left * scale, top = edge.top * scale;
    const image = context.createImageData(width, this.canvas.height), pixels = new Uint32Array(image.data.buffer);
    const px = this.x.places, py = this.y.places;
    const size = px.length > 20000 ? Math.round(scale) : Math.round(2 * scale);
    const packed = colors.map(([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0);
    const faint = (70 << 24 | 150 << 16 | 140 << 8 | 130) >>> 0;
    for (let pass = 0; pass < 2; pass++) {
      for (let i = 0; i < px.length; i++) {
        if (fits[i] !== pass) continue;
        const u = px[i], v = py[i];
        if (!(u >= 0 && u <= 1 && v >= 0 && v <= 1)) continue;
        const color = pass ? packed[codes[i]] : faint;
        const column = (left + u * wide * scale) | 0, line = (top + (1 - v) * high * scale) | 0;
        for (let dy = 0; dy < size; dy++) for (let dx = 0; dx < size; dx++) pixels[(line + dy) * width + column + dx] = color;
      }
    }
    return image;
  }

  drawAxes(context, wide, high) {
    const { x, y } = this;
    context.globalAlpha = 0.1;
    context.fillRect(0, 0, x.strip * wide, high);
    context.fillRect(0, (1 - y.strip) * high, wide, y.strip * high);
    context.textAlign = "center";
    for (const value of x.ticks()) {
      const u = x.place(value) * wide;
      context.globalAlpha = 0.75; context.fillText(tickText(value), u, high + 14);
      context.globalAlpha = 0.12; context.fillRect(u, 0, 1, high);
    }
    context.textAlign = "right";
    for (const value of y.ticks()) {
      const v = (1 - y.place(value)) * high;
      context.globalAlpha = 0.75; context.fillText(tickText(value), -5, v + 4);
      context.globalAlpha = 0.12; context.fillRect(0, v, wide, 1);
    }
    context.globalAlpha = 1;
  }

  drawBrush(context, path) {
    context.lineWidth = 1.5;
    context.beginPath();
    if (this.isLasso) path.forEach((spot, k) => (k ? context.lineTo(...spot) : context.moveTo(...spot)));
    else {
      const [[a, b], [c, d]] = [path[0], path[path.length - 1]];
      context.rect(Math.min(a, c), Math.min(b, d), Math.abs(c - a), Math.abs(d - b));
    }
    context.closePath();
    context.globalAlpha = 0.12; context.fill(); context.globalAlpha = 1; context.stroke();
  }
}

// A line a run over several columns; a drag along an axis lists only the runs that cross it there.
class Parallel {
  constructor(canvas, brushed) {
    this.canvas = canvas; this.axes = []; this.drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const [k, v] = this.spot(event);
      this.drag = { k, from: v, to: v };
    });
    canvas.addEventListener("pointermove", (event) => { if (this.drag) { this.drag.to = this.spot(event)[1]; this.redrawn(); } });
    canvas.addEventListener("pointerup", () => {
      const drag = this.drag;
      this.drag = null;
      const axis = drag && this.axes[drag.k];
      if (!axis) return;
      const [low, high] = [Math.min(drag.from, drag.to), Math.max(drag.from, drag.to)];
      brushed(axis.name, high - low < 0.02 ? null : axis.range(low, high));
    });
    this.redrawn = () => {};
  }
  spot(event) {
    const at = pressed(event, this.canvas);
    const step = (at.width - 40) / Math.max(1, this.axes.length - 1);
    const k = Math.round((at.x - 20) / step);
    const v = 1 - (at.y - 10) / (at.height - 40);
    return [Math.min(this.axes.length - 1, Math.max(0, k)), Math.min(1, Math.max(0, v))];
  }
  draw(axes, listed, colors, codes, ranges, titles) {
    this.axes = axes;
    const canvas = this.canvas, scale = sized(canvas), context = canvas.getContext("2d");
    context.setTransform(scale, 0, 0, scale, 0, 0);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    context.clearRect(0, 0, width, height);
    const step = (width - 40) / Math.max(1, axes.length - 1), tall = height - 40;
    const every = Math.max(1, Math.ceil(listed.length / MAX_LINES));
    context.globalAlpha = Math.max(0.06, Math.min(0.6, 120 / Math.max(1, listed.length / every)));
    context.lineWidth = 1;
    for (let at = 0; at < listed.length; at += every) {
      const i = listed[at];
      context.strokeStyle = colors[codes[i]];
      context.beginPath();
      axes.forEach((axis, k) => {
        const x = 20 + k * step, y = 10 + (1 - axis.places[i]) * tall;
        if (k) context.lineTo(x, y); else context.moveTo(x, y);
      });
      context.stroke();
    }
    context.globalAlpha = 1;
    const words = getComputedStyle(document.body).color;
    context.font = "10.5px system-ui, sans-serif";
    axes.forEach((axis, k) => {
      const x = 20 + k * step;
      context.fillStyle = words;
      context.globalAlpha = 0.5; context.fillRect(x, 10, 1, tall);
      context.globalAlpha = 0.1; context.fillRect(x - 6, 10 + (1 - axis.strip) * tall, 13, axis.strip * tall); context.globalAlpha = 1;
      context.textAlign = k === 0 ? "left" : k === axes.length - 1 ? "right" : "center";
      const at = k === 0 ? 2 : k === axes.length - 1 ? width - 2 : x;
      context.fillText(clipped(context, titles[k], step * 1.02), at, height - 16 + (k % 2) * 12);
      const drag = this.drag && this.drag.k === k ? axis.range(this.drag.from, this.drag.to) : null;
      const range = drag || ranges[axis.name];
      if (range) {
        const [a, b] = axis.span(range);
        context.globalAlpha = 0.35; context.fillRect(x - 6, 10 + (1 - b) * tall, 13, Math.max(2, (b - a) * tall)); context.globalAlpha = 1;
      }
    });
    return every;
  }
}

function clipped(context, text, width) {
  let short = text;
  while (short.length > 3 && context.measureText(short).width > 2 * width - 8) short = short.slice(0, -2) + "…";
  return short;
}
