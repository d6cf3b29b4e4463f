// The history, each kind of quantity in a frame of its own, with the time that the page shows.
const CURVE_COLOURS = ["--first", "--second", "--third", "--fourth", "--fifth"];

PARTS.curves = (data, arrays, clock) => {
  const all = data.curves.map((curve, k) => {
    const place = element("div", { class: "curve", id: `curve-${k}` }), unit = element("span", { class: "note" }, curve.unit);
    const card = element("section", { class: "card third" }, element("h2", {}, `${curve.title} `, unit), place);
    document.querySelector("[data-part=curves]").append(card);
    return new Curve(place, data.times, curve, clock);
  });
  clock.onChange(() => all.forEach((curve) => curve.mark()));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => all.forEach((curve) => curve.draw()));
};

// With room around what stays but for rounding, which is no jump from 0 to 100.
function rangeOf(plot, low, high) {
  const size = Math.max(Math.abs(low), Math.abs(high)), isConstant = high - low <= 1e-9 * size;
  if (isConstant) return [low - 0.1 * (size || 1), high + 0.1 * (size || 1)];
  return LIBRARIES.uPlot.rangeNum(low, high, 0.1, true);
}

class Curve {
  constructor(place, times, curve, clock) {
    Object.assign(this, { place, times, curve, clock });
    this.frame = element("div", { role: "img", "aria-label": `${curve.title} over time` });
    this.values = element("div", { class: "values" });
    place.append(this.frame, this.values);
    this.draw();
    new ResizeObserver(() => this.plot.setSize(this.size())).observe(place);
  }

  size() { return { width: Math.max(160, this.place.clientWidth), height: 190 }; }

  draw() {
    this.plot?.destroy();
    const axis = (label) => ({
      label, labelSize: 16, labelFont: "12px sans-serif", stroke: colourOf("--soft"), grid: { stroke: colourOf("--line"), width: 1 }, ticks: { show: false }, font: "12px sans-serif",
    });
    const lines = this.curve.series.map((_, k) => ({
      stroke: colourOf(CURVE_COLOURS[k % CURVE_COLOURS.length]), width: 1.6, spanGaps: false, points: { show: false },
    }));
    const options = {
      ...this.size(), legend: { show: false }, scales: { x: { time: false }, y: { range: rangeOf } },
      axes: [{ ...axis("time"), size: 34 }, { ...axis([this.curve.title, this.curve.unit].filter(Boolean).join(", ")), size: 56 }], series: [{}, ...lines],
      cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
      hooks: { draw: [(plot) => this.drawMark(plot)] },
    };
    const rows = [this.times, ...this.curve.series.map((series) => series.values)];
    this.plot = new LIBRARIES.uPlot(options, rows, this.frame);
    const go = (event) => {
      const left = event.clientX - this.plot.over.getBoundingClientRect().left;
      this.clock.showNearest(this.plot.posToVal(left, "x"));
    };
    this.plot.over.addEventListener("pointerdown", go);
    this.plot.over.addEventListener("pointermove", (event) => { if (event.buttons) go(event); });
    this.mark();
  }

  drawMark(plot) {
    const { ctx, bbox } = plot, x = Math.round(plot.valToPos(this.clock.time, "x", true));
    ctx.save();
    ctx.strokeStyle = colourOf("--text");
    ctx.setLineDash([4, 4]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }

  mark() {
    this.plot.redraw(false);
    let row = 0;
    this.times.forEach((time, k) => {
      if (Math.abs(time - this.clock.time) < Math.abs(this.times[row] - this.clock.time)) row = k;
    });
    const unit = this.curve.unit && (this.curve.unit === "°" ? "°" : ` ${this.curve.unit}`);
    this.values.replaceChildren(element("span", {}, `t = ${inDigits(this.times[row])}`));
    this.curve.series.forEach((series, k) => {
      const swatch = element("i");
      swatch.style.background = `var(${CURVE_COLOURS[k % CURVE_COLOURS.length]})`;
      this.values.append(element("span", {}, swatch, `${series.name} `, element("b", {}, inDigits(series.values[row]) + unit)));
    });
  }
}
