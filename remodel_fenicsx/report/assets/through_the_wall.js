// Cauchy's stress, with what the law of Laplace gives, and content, through the wall at the time that the page shows.
const LINES = ["--first", "--second", "--third"];

for (const name of ["stress", "content"]) {
  PARTS[name] = (data, arrays, clock) => {
    const place = document.getElementById(name);
    clock.onChange(() => place.replaceChildren(wallDrawing(data, clock, name)));
  };
}

function wallDrawing(data, clock, what) {
  const all = [...data.layers.flat(2), ...data.level.filter(Number.isFinite), 0];
  const low = Math.min(...all), size = Math.max(...all) - low || 1;
  const x = (depth) => 48 + 220 * depth, y = (value) => 168 - (152 * (value - low)) / size;
  const drawing = element("svg", { viewBox: "0 0 345 196", role: "img" });
  drawing.append(element("title", {}, `Mean ${what} ${data.through} at t = ${inDigits(clock.time)}`));
  for (const value of [0, low, low + size / 2, low + size]) {
    drawing.append(element("line", { x1: 48, x2: 268, y1: y(value), y2: y(value), stroke: "var(--line)" }));
    drawing.append(element("text", { x: 43, y: y(value) + 4, "text-anchor": "end" }, inDigits(value)));
  }
  const rows = data.layers[clock.index], level = data.level[clock.index];
  if (Number.isFinite(level)) {
    const at = { x1: 48, x2: 268, y1: y(level), y2: y(level), stroke: "var(--text)", "stroke-dasharray": "5 4" };
    drawing.append(element("line", at));
  }
  const ends = [];
  data.names.forEach((name, k) => {
    const colour = LINES[k];
    const points = rows.map((row, layer) => [x(data.depth[layer]), y(row[k])]);
    const path = points.map(([a, b], i) => `${i ? "L" : "M"}${a.toFixed(1)} ${b.toFixed(1)}`).join("");
    drawing.append(element("path", { d: path, fill: "none", stroke: `var(${colour})`, "stroke-width": 2.2 }));
    for (const [cx, cy] of points) drawing.append(element("circle", { cx, cy, r: 2.5, fill: `var(${colour})` }));
    ends.push({ name, y: points.at(-1)[1] });
  });
  ends.sort((a, b) => a.y - b.y);
  apart(ends.map((end) => end.y)).forEach((place, k) => {
    drawing.append(element("text", { x: 274, y: place + 4 }, ends[k].name));
  });
  drawing.append(element("text", { x: 158, y: 188, "text-anchor": "middle" }, data.through));
  return drawing;
}
