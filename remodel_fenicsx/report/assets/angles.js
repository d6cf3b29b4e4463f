// The fibre angle through the body, and where the collagen points: means over volumes of the elements.
const NO_ANGLE = 255, ANGLE_STEPS = 252;
const degreesOf = (step) => ((step + 0.5) * 90) / ANGLE_STEPS;

// Of each layer the mean and the angles below which 10 and 90 % of its volume are; NaN where no chain has an angle.
function profileOf(steps, layer, volume, layers) {
  const shares = Array.from({ length: layers }, () => new Float64Array(ANGLE_STEPS));
  steps.forEach((step, e) => { if (step !== NO_ANGLE) shares[layer[e]][step] += volume[e]; });
  return shares.map((share) => {
    const total = share.reduce((a, b) => a + b, 0);
    const mean = share.reduce((sum, part, step) => sum + part * degreesOf(step), 0) / total;
    const below = (part) => {
      let sum = 0, step = 0;
      while (step < ANGLE_STEPS - 1 && (sum += share[step]) < part * total) step++;
      return degreesOf(step);
    };
    return { mean, low: below(0.1), high: below(0.9) };
  });
}

// Share of the volume in each of equal parts of 0 to 90 degrees; chains without an angle are left out.
function roseOf(steps, volume, parts) {
  const share = new Float64Array(parts);
  steps.forEach((step, e) => { if (step !== NO_ANGLE) share[Math.floor((step * parts) / ANGLE_STEPS)] += volume[e]; });
  const total = share.reduce((a, b) => a + b, 0);
  return total ? share.map((part) => part / total) : share;
}

PARTS.angles = (data, arrays, clock) => {
  const { angle, layer, volume } = arrays.view, count = layer.length, layers = data.depth.length;
  const stepsAt = (index) => angle.subarray(index * count, (index + 1) * count);
  const profiles = new Map();
  const profileAt = (index) => {
    if (!profiles.has(index)) profiles.set(index, profileOf(stepsAt(index), layer, volume, layers));
    return profiles.get(index);
  };
  const last = clock.times.length - 1;
  const others = [...new Set([0, 1, 2, 3, 4].map((k) => Math.round((k * last) / 4)))];
  if (layers < 2) document.getElementById("profile").closest("section").remove();
  const profile = document.getElementById("profile"), rose = document.getElementById("rose");
  clock.onChange(() => {
    if (profile) profile.replaceChildren(profileDrawing(data, clock, others, profileAt));
    const shares = roseOf(stepsAt(clock.index), volume, data.colours.length);
    rose.replaceChildren(roseDrawing(data, clock, shares));
  });
  clock.profileAt = profileAt;
  clock.roseAt = (index) => roseOf(stepsAt(index), volume, data.colours.length);
};

// Places in rising order, moved down and up alike until labels there do not lie upon each other.
function apart(places) {
  const down = [...places], up = [...places];
  for (let k = 1; k < places.length; k++) down[k] = Math.max(down[k], down[k - 1] + 12);
  for (let k = places.length - 2; k >= 0; k--) up[k] = Math.min(up[k], up[k + 1] - 12);
  return places.map((_, k) => (down[k] + up[k]) / 2);
}

function profileDrawing(data, clock, others, profileAt) {
  const x = (depth) => 34 + 226 * depth, y = (degrees) => 168 - 1.7 * degrees;
  const drawing = element("svg", { viewBox: "0 0 345 196", role: "img" });
  drawing.append(element("title", {}, `Mean fibre angle ${data.through} at t = ${inDigits(clock.time)}`));
  for (const degrees of [0, 30, 60, 90]) {
    drawing.append(element("line", { x1: 34, x2: 260, y1: y(degrees), y2: y(degrees), stroke: "var(--line)" }));
    drawing.append(element("text", { x: 28, y: y(degrees) + 4, "text-anchor": "end" }, `${degrees}°`));
  }
  for (const region of data.regions) {  // the name of each, and where the next one begins
    const middle = x((region.from + region.to) / 2);
    drawing.append(element("text", { x: middle, y: 10, "text-anchor": "middle", class: "region" }, region.name));
    if (region.to < 1) {
      const at = { x1: x(region.to), x2: x(region.to), y1: y(90), y2: y(0) };
      drawing.append(element("line", { ...at, stroke: "var(--soft)", "stroke-dasharray": "4 3", class: "region" }));
    }
  }
  const known = (profile) => profile.map((layer, k) => ({ ...layer, depth: data.depth[k] }))
    .filter((layer) => Number.isFinite(layer.mean));
  const path = (points) => points.map(([a, b], k) => `${k ? "L" : "M"}${a.toFixed(1)} ${b.toFixed(1)}`).join("");
  const labels = [];
  for (const index of [...others.filter((other) => other !== clock.index), clock.index]) {
    const layers = known(profileAt(index)), isNow = index === clock.index;
    if (!layers.length) continue;
    const middle = layers.map((layer) => [x(layer.depth), y(layer.mean)]);
    if (isNow) {
      const band = [...layers.map((layer) => [x(layer.depth), y(layer.high)]),
        ...layers.toReversed().map((layer) => [x(layer.depth), y(layer.low)])];
      drawing.append(element("path", { d: `${path(band)}Z`, fill: "var(--first)", opacity: 0.15 }));
      middle.forEach(([cx, cy]) => drawing.append(element("circle", { cx, cy, r: 3, fill: "var(--first)" })));
    }
    const stroke = isNow ? "var(--first)" : "var(--soft)";
    drawing.append(element("path", { d: path(middle), fill: "none", stroke, "stroke-width": isNow ? 2.2 : 0.7 }));
    labels.push({ end: middle.at(-1), text: `t = ${inDigits(clock.times[index])}` });
  }
  labels.sort((a, b) => a.end[1] - b.end[1]);
  apart(labels.map((label) => label.end[1])).forEach((place, k) => {
    const { end: [x1, y1], text } = labels[k], stroke = "var(--soft)";
    drawing.append(element("line", { x1: x1 + 4, y1, x2: 277, y2: place, stroke, "stroke-width": 0.5, class: "leader" }));
    drawing.append(element("text", { x: 280, y: place + 4 }, text));
  });
  drawing.append(element("text", { x: 147, y: 188, "text-anchor": "middle" }, data.through));
  return drawing;
}

function roseDrawing(data, clock, shares) {
  const radius = 88, largest = Math.max(...shares, 1e-9), step = Math.PI / 2 / shares.length;
  const drawing = element("svg", { viewBox: "-190 -112 380 236", role: "img" });
  drawing.append(element("title", {}, `Share of the volume by fibre angle at t = ${inDigits(clock.time)}`));
  for (const part of [0.25, 0.5, 0.75, 1]) {
    const r = radius * Math.sqrt(part);
    drawing.append(element("circle", { r, fill: "none", stroke: "var(--line)" }));
  }
  shares.forEach((share, k) => {
    const r = radius * Math.sqrt(share / largest);  // its area is the share
    for (const [sx, sy] of [[1, 1], [-1, 1], [-1, -1], [1, -1]]) {
      const end = (angle) => `${(sx * r * Math.cos(angle)).toFixed(2)} ${(-sy * r * Math.sin(angle)).toFixed(2)}`;
      drawing.append(element("path", { d: `M0 0L${end(k * step)}L${end((k + 1) * step)}Z`, fill: data.colours[k] }));
    }
  });
  drawing.append(element("text", { x: radius + 6, y: 4 }, `0° ${data.along}`));
  drawing.append(element("text", { x: 0, y: -radius - 8, "text-anchor": "middle" }, `90° ${data.across}`));
  const words = `outer ring: ${inDigits(100 * largest)} % of the volume in ${90 / shares.length}°`;
  drawing.append(element("text", { x: 0, y: radius + 26, "text-anchor": "middle" }, words));
  return drawing;
}
