// What Python has put into the page, and the time that all of it shows.
"use strict";
const PAGE = JSON.parse(document.getElementById("page-data").textContent);
const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array,
};
const PARTS = {};  // by the name of a card: function(data of the card, arrays of all by card and name, clock)

// Rows that are stored as differences to the row before, modulo the range of the type.
function sumUp(values, row) {
  for (let i = row; i < values.length; i++) values[i] += values[i - row];
}

async function unpacked() {
  const text = atob(document.getElementById("page-arrays").textContent), deflated = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) deflated[i] = text.charCodeAt(i);
  const stream = new Blob([deflated]).stream().pipeThrough(new DecompressionStream("gzip"));
  const block = await new Response(stream).arrayBuffer();
  const arrays = {};
  for (const [path, entry] of Object.entries(PAGE.arrays)) {
    const dot = path.indexOf("."), card = path.slice(0, dot), length = entry.shape.reduce((a, b) => a * b, 1);
    const values = new TYPES[entry.type](block, entry.start, length);
    if (entry.differences) sumUp(values, length / entry.shape[0]);
    (arrays[card] ??= {})[path.slice(dot + 1)] = values;
  }
  return arrays;
}

// The times that can be shown, which one is, and who wants to know.
class Clock {
  constructor(times) { this.times = times; this.index = times.length - 1; this.listeners = []; }
  get time() { return this.times[this.index]; }
  onChange(listener) { this.listeners.push(listener); }
  show(index) {
    this.index = Math.max(0, Math.min(this.times.length - 1, index));
    for (const listener of this.listeners) listener(this);
  }
  showNearest(time) {
    let best = 0;
    this.times.forEach((t, i) => { if (Math.abs(t - time) < Math.abs(this.times[best] - time)) best = i; });
    this.show(best);
  }
}

function element(name, attributes = {}, ...children) {
  const isDrawing = ["svg", "g", "path", "line", "circle", "text", "title", "polyline"].includes(name);
  const made = isDrawing ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const colourOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const inDigits = (value) => (value === null || !Number.isFinite(value) ? "–" : String(Number(value.toPrecision(4))));

function save(name, blob) {
  const link = element("a", { download: name, href: URL.createObjectURL(blob) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
