// Cauchy's stress, with what the law of Laplace gives, also by sector, and content, through the wall at the time that the page shows.
const LINES = ["--first", "--second", "--third"];
const lineColour = (k, count) => (count > LINES.length ? `hsl(${Math.round((260 * (count - 1 - k)) / (count - 1))} 65% 45%)` : `var(${LINES[k]})`);

for (const name of ["stress", "sectors", "content"]) {
  PARTS[name] = (data, arrays, clock) => {
    const place = document.getElementById(name);
    clock.onChange(() => place.replaceChildren(wallDrawing(data, clock, name)));
  };
}

// Multiples of 1, 2 or 5 times a power of ten, some four of them, around two numbers.
function roundTicks(low, high) {
  const raw = (high - low || Math.abs(high) || 1) / 3, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw * (1 - 1e-9));
  const first = Math.floor(low / step + 1e-9), last = Math.max(first + 1, Math.ceil(high / step - 1e-9));
  return Array.from({ length: last - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(6)));
}

function wallDrawing(data, clock, what) {
  const all = [...data.layers.flat(2), ...data.level.filter(Number.isFinite), 0];
  const ticks = roundTicks(Math.min(...all), Math.max(...all)), low = ticks[0], size = ticks.at(-1) - low;
  const x = (depth) => 48 + 220 * depth, y = (value) => 168 - (152 * (value - low)) / size;
  const drawing = element("svg", { viewBox: "0 0 345 196", role: "img" });
  drawing.append(element("title", {}, `Mean ${what} ${data.through} at t = ${inDigits(clock.time)}`));
  for (const value of ticks) {
    drawing.append(element("line", { x1: 48, x2: 268, y1: y(value), y2: y(value), stroke: "var(--line)" }));
    drawing.append(element("text", { x: 43, y: y(value) + 4, "text-anchor": "end" }, inDigits(value)));
  }
  const label = { transform: "translate(11 92) rotate(-90)", "text-anchor": "middle", class: "label" };
  drawing.append(element("text", label, data.label));
  const rows = data.layers[clock.index], level = data.level[clock.index];
  if (Number.isFinite(level)) {
    const at = { x1: 48, x2: 268, y1: y(level), y2: y(level), stroke: "var(--text)", "stroke-dasharray": "5 4" };
    drawing.append(element("line", at));
  }
  const ends = [];
  data.names.forEach((name, k) => {
    const colour = lineColour(k, data.names.length);
    const points = rows.map((row, layer) => [x(data.depth[layer]), y(row[k])]);
    const path = points.map(([a, b], i) => `${i ? "L" : "M"}${a.toFixed(1)} ${b.toFixed(1)}`).join("");
    drawing.append(element("path", { d: path, fill: "none", stroke: colour, "stroke-width": 2.2 }));
    for (const [cx, cy] of points) drawing.append(element("circle", { cx, cy, r: 2.5, fill: colour }));
    ends.push({ name, colour, y: points.at(-1)[1] });
  });
  ends.sort((a, b) => a.y - b.y);
  apart(ends.map((end) => end.y)).forEach((place, k) => {
    const label = element("text", { x: 274, y: place + 4 }, ends[k].name);
    label.style.fill = ends[k].colour;
    drawing.append(label);
  });
  drawing.append(element("text", { x: 158, y: 188, "text-anchor": "middle" }, data.through));
  return drawing;
}
