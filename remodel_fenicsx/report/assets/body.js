// The body in space: the surface of the elements that are shown, coloured, with the chains of each on its faces.
const FACES = {
  8: [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
  4: [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
};
const SIGNS = [[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]];  // the four chains of a cell: sums of its edges
const GREY = [0.91, 0.92, 0.94], NOTHING_KNOWN = [0.6, 0.62, 0.65];
const EDGE_LIFT = 0.02;  // of lines between elements towards the eye, over the smallest side of a face
const WORDS_OVER_THE_BODY = 62;  // pixels at the top and at the bottom that buttons and scale take
const EXTENSION_COLOURS = ["#fff7d6", "#fbd98a", "#f5a754", "#e0662f", "#a8281e", "#4f0a16"];
const STRESS_COLOURS = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
const STRESSES = {
  hoop_stress: "hoop stress", axial_stress: "axial stress",
  max_principal_stress: "largest principal stress", von_mises_stress: "von Mises stress",
};

const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const vectorAt = (values, k) => [values[3 * k], values[3 * k + 1], values[3 * k + 2]];
const mean = (places) => times(places.reduce((a, b) => add(a, b)), 1 / places.length);

// What does not depend on how it is looked at: elements, their neighbours, places at a time.
class Elements {
  constructor(data, arrays) {
    Object.assign(this, { data, arrays });
    this.count = arrays.layer.length;
    this.corners = arrays.elements.length / this.count;
    this.nodes = arrays.reference.length / 3;
    this.faces = FACES[this.corners];
    this.neighbours = this.findNeighbours();
    this.place = new Float32Array(3 * this.nodes);
    this.centres = this.findCentres();
    this.box = this.findBox();
  }

  node(e, corner) { return this.arrays.elements[e * this.corners + corner]; }
  reference(node) { return vectorAt(this.arrays.reference, node); }
  at(node) { return vectorAt(this.place, node); }
  centre(e) {
    const sum = [0, 0, 0];
    for (let k = 0; k < this.corners; k++) {
      for (let i = 0; i < 3; i++) sum[i] += this.place[3 * this.node(e, k) + i] / this.corners;
    }
    return sum;
  }

  // In the reference body, three numbers an element.
  findCentres() {
    const found = new Float32Array(3 * this.count);
    for (let k = 0; k < this.arrays.elements.length; k++) {
      const e = Math.floor(k / this.corners), node = this.arrays.elements[k];
      for (let i = 0; i < 3; i++) found[3 * e + i] += this.arrays.reference[3 * node + i] / this.corners;
    }
    return found;
  }

  // The element on the other side of each face; -1 where there is none. Three nodes tell a face.
  findNeighbours() {
    const found = new Int32Array(this.count * this.faces.length).fill(-1), open = new Map();
    for (let e = 0; e < this.count; e++) {
      this.faces.forEach((face, f) => {
        const [a, b, c] = face.map((corner) => this.node(e, corner)).sort((x, y) => x - y);
        const key = (a * this.nodes + b) * this.nodes + c, mine = e * this.faces.length + f, other = open.get(key);
        if (other === undefined) { open.set(key, mine); return; }
        found[mine] = Math.floor(other / this.faces.length);
        found[other] = e;
        open.delete(key);
      });
    }
    return found;
  }

  // Least and largest coordinates over all times.
  findBox() {
    const { position } = this.arrays, largest = [0, 0, 0];
    for (let k = 0; k < position.length; k++) if (position[k] > largest[k % 3]) largest[k % 3] = position[k];
    return [this.data.origin, add(this.data.origin, largest, this.data.position_step)];
  }

  moveTo(index) {
    const { position } = this.arrays, start = index * this.place.length;
    for (let k = 0; k < this.place.length; k++) {
      this.place[k] = this.data.origin[k % 3] + this.data.position_step * position[start + k];
    }
  }

  // The half of each chain of an element at a time, in link lengths.
  chains(index, e) {
    const { edges } = this.arrays, start = (index * this.count + e) * 9, step = this.data.edge_step;
    const edge = [0, 3, 6].map((k) => [edges[start + k], edges[start + k + 1], edges[start + k + 2]]);
    return SIGNS.map((sign) => times(add(add(times(edge[0], sign[0]), edge[1], sign[1]), edge[2], sign[2]), step));
  }

  // Faces of the shown elements that no other shown one covers: [element, nodes].
  surface(isShown) {
    const found = [];
    for (let e = 0; e < this.count; e++) {
      if (!isShown(e)) continue;
      this.faces.forEach((face, f) => {
        const other = this.neighbours[e * this.faces.length + f];
        if (other >= 0 && isShown(other)) return;
        const nodes = face.map((corner) => this.node(e, corner));
        found.push({ element: e, nodes, size: this.smallestSide(nodes) });
      });
    }
    return found.filter((face) => face.size > 0);
  }

  // Mean over the faces of an element of their smallest sides.
  size(e) {
    const sides = this.faces.map((face) => this.smallestSide(face.map((corner) => this.node(e, corner))));
    return sides.reduce((a, b) => a + b) / sides.length;
  }

  // Wedges on an axis are hexahedra with a side of no length.
  smallestSide(nodes) {
    const places = nodes.map((node) => this.reference(node));
    const sides = places.map((place, k) => Math.hypot(...add(places[(k + 1) % places.length], place, -1)));
    return Math.min(...sides.filter((side) => side > 0));
  }
}

// Ribbons of the chains of an element on one of its faces: they stay in it and clear of its edge, so that those of
// neighbours do not read as one line. The rule is that of the figures (pictures.py).
function ribbonsOn(face, corners, inside, chains, rule) {
  const middle = mean(corners);
  let normal = corners.length === 4
    ? cross(add(corners[2], corners[0], -1), add(corners[3], corners[1], -1))
    : cross(add(corners[1], corners[0], -1), add(corners[2], corners[0], -1));
  const length = Math.hypot(...normal);
  if (!(length > 0)) return [];
  normal = times(normal, (dot(normal, add(middle, inside, -1)) < 0 ? -1 : 1) / length);
  const onPlane = (vector) => add(vector, normal, -dot(vector, normal));
  const flat = corners.map((corner) => onPlane(add(corner, middle, -1)));
  const outward = flat.map((corner, k) => cross(add(flat[(k + 1) % flat.length], corner, -1), normal));
  const room = outward.map((direction, k) => Math.abs(dot(direction, flat[k])));
  return chains.map((chain) => {
    const arm = onPlane(times(chain, rule.reach * face.size));
    const reach = Math.min(...outward.map((direction, k) => room[k] / (Math.abs(dot(direction, arm)) || 1e-300)));
    const half = times(arm, Math.min(1, rule.room * reach)), across = cross(normal, half);
    const side = times(across, (rule.width * face.size) / 2 / (Math.hypot(...across) || 1));
    return [add(add(middle, half, -1), side, -1), add(add(middle, half), side, -1),
      add(add(middle, half), side), add(add(middle, half, -1), side)];
  });
}

function geometryOf(positions, colours) {
  const { BufferAttribute, BufferGeometry } = LIBRARIES, geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
  if (colours) geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
  return geometry;
}

// What is drawn, and from where it is seen.
class Stage {
  constructor(canvas, box, data) {
    const L = LIBRARIES;
    L.ColorManagement.enabled = false;  // a colour of the scale is that colour on the screen
    Object.assign(this, { canvas, box, data });
    this.renderer = new L.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = L.LinearSRGBColorSpace;
    this.camera = new L.OrthographicCamera();
    this.camera.up.set(0, 0, 1);
    this.scene = new L.Scene();
    const light = new L.DirectionalLight("#ffffff", (1 - data.ambient) * Math.PI);  // from the eye
    this.camera.add(light, light.target);
    light.target.position.set(0, 0, -1);
    this.scene.add(this.camera, new L.AmbientLight("#ffffff", data.ambient * Math.PI));
    const shared = { vertexColors: true };
    this.surface = new L.Mesh(geometryOf([]), new L.MeshLambertMaterial({ ...shared, side: L.DoubleSide, flatShading: true }));
    this.edges = new L.LineSegments(geometryOf([]), new L.LineBasicMaterial({ color: "#777777" }));
    this.ribbons = new L.Mesh(geometryOf([]), new L.MeshBasicMaterial(shared));  // not seen from behind
    this.threads = new L.LineSegments(geometryOf([]), new L.LineBasicMaterial(shared));
    for (const drawn of [this.surface, this.edges, this.ribbons, this.threads]) {
      drawn.frustumCulled = false;
      this.scene.add(drawn);
    }
    this.turning = new L.OrbitControls(this.camera, canvas);
    this.turning.enablePan = this.turning.enableZoom = false;
    this.turning.listenToKeyEvents(canvas);  // with shift
    canvas.style.touchAction = "pan-y";
    canvas.addEventListener("focus", () => { this.turning.enableZoom = true; });  // else the wheel moves the page
    canvas.addEventListener("blur", () => { this.turning.enableZoom = false; });
    this.turning.addEventListener("change", () => this.draw());
    this.lift = 0;
    this.look(data.views.front);
    new ResizeObserver(() => this.fit()).observe(canvas.parentElement);
  }

  // From a direction, the whole box in the picture.
  look(direction) {
    const middle = times(add(this.box[0], this.box[1]), 0.5), size = Math.hypot(...add(this.box[1], this.box[0], -1)) || 1;
    this.size = size;
    this.turning.target.set(...middle);
    this.camera.position.set(...add(middle, direction, (2 * size) / Math.hypot(...direction)));
    this.camera.zoom = 1;
    this.camera.near = size / 100;
    this.camera.far = 5 * size;
    this.camera.lookAt(...middle);
    this.fit();
    this.turning.update();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.camera.updateMatrixWorld();
    const inverse = this.camera.matrixWorldInverse.elements, half = add(this.box[1], this.box[0], -1);
    const extent = (row) => [0, 1, 2].reduce((sum, k) => sum + Math.abs(inverse[4 * k + row] * half[k]) / 2, 0);
    const free = Math.max(0.5 * height, height - 2 * WORDS_OVER_THE_BODY);
    const tall = Math.max((extent(1) * height) / free, (1.08 * extent(0) * height) / width) || 1;
    Object.assign(this.camera, { top: tall, bottom: -tall, right: (tall * width) / height, left: (-tall * width) / height });
    this.camera.updateProjectionMatrix();
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.draw();
  }

  // In a parallel view what is moved towards the eye stays where it is in the picture, and nothing covers it.
  draw() {
    const towards = this.camera.position.clone().sub(this.turning.target).normalize();
    this.edges.position.copy(towards).multiplyScalar(EDGE_LIFT * this.lift);
    this.ribbons.position.copy(towards).multiplyScalar(this.data.chain.lift * this.lift);
    this.renderer.render(this.scene, this.camera);
  }

  put(name, positions, colours) {
    this[name].geometry.dispose();
    this[name].geometry = geometryOf(positions, colours);
  }
}

// The colour at a share from 0 to 1 of the way through some colours.
function between(colours, share) {
  const last = colours.length - 1, place = Math.max(0, Math.min(last, share * last)), k = Math.min(last - 1, Math.floor(place));
  return add(times(colours[k], 1 - place + k), colours[k + 1], place - k);
}

// Which elements are shown and how.
class Body {
  constructor(data, arrays, clock) {
    Object.assign(this, { data, arrays, clock });
    this.elements = new Elements(data, arrays);
    this.stage = new Stage(document.getElementById("body"), this.elements.box, data);
    this.colours = data.colours.map(rgb);
    this.warm = EXTENSION_COLOURS.map(rgb);
    this.green = STRESS_COLOURS.map(rgb);
    this.peeled = 0;
    this.cut = "whole";
    const ways = document.getElementById("shown"), isThere = (way) => way.dataset.needs.split(" ").every((name) => name in arrays);
    for (const way of [...ways.options]) if (!isThere(way)) way.remove();
    this.mode = ways.value;
    this.select();
  }

  isShown(e) {
    const { centres, box } = this.elements, middle = times(add(box[0], box[1]), 0.5);
    if (this.arrays.layer[e] >= this.data.layers - this.peeled) return false;
    const isFront = centres[3 * e + 1] < middle[1], isRight = centres[3 * e] > middle[0];
    return !(this.cut === "half" && isFront) && !(this.cut === "quarter" && isFront && isRight);
  }

  select() {
    const shown = Uint8Array.from({ length: this.elements.count }, (_, e) => this.isShown(e));
    this.shown = shown;
    this.faces = this.elements.surface((e) => shown[e]);
    const sizes = this.faces.map((face) => face.size).sort((a, b) => a - b);
    this.stage.lift = sizes[sizes.length >> 1] ?? 0;
  }

  colourOf(e) {
    const at = this.clock.index * this.elements.count + e;
    if (this.mode === "extension") return this.warmth(this.arrays.extension[at] / 255);
    if (this.mode in STRESSES) return between(this.green, this.arrays[this.mode][at] / 255);
    if (!this.arrays.angle || this.mode === "shape") return GREY;
    const step = this.arrays.angle[at];
    return step === NO_ANGLE ? NOTHING_KNOWN : this.colours[Math.floor((step * this.colours.length) / ANGLE_STEPS)];
  }

  warmth(extension) {
    const least = this.data.least_extension;
    return between(this.warm, (extension - least) / (1 - least));
  }

  show() {
    this.elements.moveTo(this.clock.index);
    const isBare = this.mode === "alone";
    this.putSurface(isBare ? [] : this.faces);
    this.putRibbons(this.mode === "both" || this.mode === "coloured" ? this.faces : []);
    this.putThreads(isBare);
    this.stage.draw();
  }

  putSurface(faces) {
    const places = [], colours = [], lines = [];
    for (const face of faces) {
      const corners = face.nodes.map((node) => this.elements.at(node));
      const colour = this.mode === "coloured" ? GREY : this.colourOf(face.element);
      for (let k = 1; k + 1 < corners.length; k++) {
        places.push(...corners[0], ...corners[k], ...corners[k + 1]);
        colours.push(...colour, ...colour, ...colour);
      }
      corners.forEach((corner, k) => lines.push(...corner, ...corners[(k + 1) % corners.length]));
    }
    this.stage.put("surface", places, colours);
    this.stage.put("edges", lines);
  }

  putRibbons(faces) {
    const places = [], colours = [];
    for (const face of faces) {
      const corners = face.nodes.map((node) => this.elements.at(node));
      const chains = this.elements.chains(this.clock.index, face.element);
      const colour = this.mode === "coloured" ? this.colourOf(face.element) : this.data.chain.colour;
      for (const [a, b, c, d] of ribbonsOn(face, corners, this.elements.centre(face.element), chains, this.data.chain)) {
        places.push(...a, ...b, ...c, ...a, ...c, ...d);
        for (let k = 0; k < 6; k++) colours.push(...colour);
      }
    }
    this.stage.put("ribbons", places, colours);
  }

  putThreads(areWanted) {
    const places = [], colours = [];
    for (let e = 0; areWanted && e < this.elements.count; e++) {
      if (!this.shown[e]) continue;
      const middle = this.elements.centre(e), colour = this.colourOf(e);
      const size = this.elements.size(e);
      for (const chain of this.elements.chains(this.clock.index, e)) {
        places.push(...add(middle, chain, this.data.chain.reach * size), ...add(middle, chain, -this.data.chain.reach * size));
        colours.push(...colour, ...colour);
      }
    }
    this.stage.put("threads", places, colours);
  }

  // The colours and what they mean.
  scale() {
    const isExtension = this.mode === "extension", isStress = this.mode in STRESSES, bar = element("div", { class: "bar" });
    if (this.mode === "shape" || (!isExtension && !isStress && !this.arrays.angle)) return [];
    const least = this.data.least_extension, count = this.data.colours.length;
    this.colours.forEach((colour, k) => {
      const share = (k + 0.5) / count, part = element("i");
      const shown = isExtension ? this.warmth(least + (1 - least) * share) : isStress ? between(this.green, share) : colour;
      part.style.background = `rgb(${shown.map((share) => Math.round(255 * share))})`;
      bar.append(part);
    });
    const [first, last] = isStress ? this.data[this.mode].map(inDigits)
      : isExtension ? [inDigits(this.data.least_extension), "1"]
      : [`0° ${this.data.words[0]}`, `90° ${this.data.words[1]}`];
    const ends = element("div", { class: "ends" }, element("span", {}, first), element("span", {}, last));
    const words = isStress ? `${STRESSES[this.mode]} ${this.data.unit}` : isExtension ? "largest r/L" : "collagen, deformed";
    return [words, bar, ends];
  }
}

PARTS.view = (data, arrays, clock) => {
  connectTime(clock);
  if (document.createElement("canvas").getContext("webgl2")) {
    connectBody(new Body(data, arrays.view, clock), clock);
  } else {  // all else works
    const words = "This browser has no WebGL: the body cannot be drawn.";
    document.querySelector(".stage").append(element("p", { class: "none" }, words));
  }
};

function connectTime(clock) {
  const slider = document.getElementById("time"), play = document.getElementById("play");
  const label = document.getElementById("clock"), speed = document.getElementById("speed");
  slider.max = clock.times.length - 1;
  slider.addEventListener("input", () => clock.show(Number(slider.value)));
  clock.onChange(() => {
    slider.value = clock.index;
    label.textContent = `t = ${inDigits(clock.time)}`;
    slider.setAttribute("aria-valuetext", label.textContent);
  });
  let timer = 0;
  const stop = () => { clearTimeout(timer); timer = 0; play.setAttribute("aria-pressed", "false"); play.textContent = "▶ play"; };
  const next = () => {
    if (clock.index + 1 >= clock.times.length) { stop(); return; }
    clock.show(clock.index + 1);
    timer = setTimeout(next, 80 / Number(speed.value));
  };
  play.addEventListener("click", () => {
    if (timer) { stop(); return; }
    if (clock.index + 1 >= clock.times.length) clock.show(0);
    play.setAttribute("aria-pressed", "true");
    play.textContent = "❚❚ pause";
    timer = setTimeout(next, 80 / Number(speed.value));
  });
}

function connectBody(body, clock) {
  const byId = (name) => document.getElementById(name), { data, stage } = body;
  const showScale = () => {
    const parts = body.scale();
    byId("scale").hidden = !parts.length;
    byId("scale").replaceChildren(...parts);
  };
  byId("shown").addEventListener("change", (event) => { body.mode = event.target.value; showScale(); body.show(); });
  byId("cut").addEventListener("change", (event) => { body.cut = event.target.value; body.select(); body.show(); });
  byId("peel").max = data.layers - 1;
  byId("peel").addEventListener("input", (event) => {
    body.peeled = Number(event.target.value);
    byId("peeled").textContent = body.peeled ? `${body.peeled} of ${data.layers} layers` : "no layer";
    body.select();
    body.show();
  });
  byId("front").addEventListener("click", () => stage.look(data.views.front));
  byId("above").addEventListener("click", () => stage.look(data.views.above));
  byId("picture").addEventListener("click", () => {
    stage.draw();
    stage.canvas.toBlob((blob) => save(`${PAGE.parts.head.name}-t${inDigits(clock.time)}.png`, blob));
  });
  clock.onChange(() => body.show());
  showScale();
}
