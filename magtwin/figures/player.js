// Player: plays a run in its lab, from the block of data that player.py packs. Draws only what changes; fetches nothing.
(() => {
"use strict";

const UNKNOWN = -2147483648;
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 28800];
const root = document.getElementById("player");
const at = (name) => root.querySelector(`[data-part="${name}"]`);

main().catch((error) => {
  root.dataset.state = "still";
  at("note").textContent = `This browser cannot play the run (${error.message}). The figures and tables are complete.`;
});

async function main() {
  const data = await unpack(document.getElementById("player-data").textContent);
  const clock = new Clock(data.arrays.t);
  for (const part of [charts, bar, words, table]) part(data, clock);
  if (data.arrays.x) {
    try {
      stage(data, clock);
      root.dataset.state = "live";
    } catch (error) {
      at("note").textContent = `The lab is not drawn: ${error.message}`;
    }
  }
  const seek = () => { // #t=30&view=top
    const told = new URLSearchParams(location.hash.slice(1));
    at("views").querySelector(`[value="${CSS.escape(told.get("view") || "")}"]`)?.click();
    if (told.get("t")) clock.seek(Number(told.get("t")) || 0);
  };
  addEventListener("hashchange", seek);
  seek();
  clock.tell();
}

// ---- Data

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const whole = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(whole.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
  const arrays = {};
  for (const [name, kind] of Object.entries(head.arrays)) arrays[name] = unpackArray(whole, 4 + length, kind);
  return { ...head, arrays };
}

// Undo the differences along the last axis and the planes of bytes of `packed` in player.py.
function unpackArray(whole, start, { shape, width, signed, at }) {
  const size = shape.reduce((a, b) => a * b, 1), row = shape[shape.length - 1];
  const values = new Int32Array(size);
  for (let k = 0; k < width; k++) {
    const plane = start + at + k * size;
    for (let i = 0; i < size; i++) values[i] |= whole[plane + i] << (8 * k);
  }
  for (let i = 0; i < size; i++) {
    if (i % row) values[i] += values[i - 1];
    if (width === 2) values[i] = signed ? (values[i] << 16) >> 16 : values[i] & 65535;
  }
  return values;
}

// The time that is shown, in hundredths of a second as in the data, and who wants to know of it.
class Clock {
  constructor(t) {
    this.t = t;
    this.now = 0;
    this.end = t[t.length - 1] / 100;
    this.pace = 1;
    this.playing = false;
    this.wanting = [];
  }
  // Index of the last row at or before now.
  get row() {
    let low = 0, high = this.t.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.t[middle] <= this.now * 100 + 1e-6) low = middle; else high = middle - 1;
    }
    return low;
  }
  // Value of a column between its rows; of headings and wheels too, as they are without jumps.
  value(column) {
    const i = this.row, j = Math.min(i + 1, this.t.length - 1), gap = this.t[j] - this.t[i];
    if (column[i] === UNKNOWN || column[j] === UNKNOWN || gap <= 0) return column[i];
    return column[i] + (column[j] - column[i]) * Math.min(1, (this.now * 100 - this.t[i]) / gap);
  }
  seek(t) {
    this.now = Math.min(this.end, Math.max(0, t));
    this.tell();
  }
  tell() { for (const want of this.wanting) want(); }
  play(on) {
    this.playing = on;
    if (on && this.now >= this.end) this.now = 0;
    let before = performance.now();
    const step = (time) => {
      if (!this.playing) return;
      this.now = Math.min(this.end, this.now + ((time - before) / 1000) * this.pace);
      before = time;
      if (this.now >= this.end) this.playing = false;
      this.tell();
      if (this.playing) requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
    this.tell();
  }
}

// ---- Words

const numbers = (digits) => new Intl.NumberFormat("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
const said = (value, digits) => (value === UNKNOWN ? "unknown" : numbers(digits).format(value).replace("-", "−"));

function words(data, clock) {
  const a = data.arrays;
  const shown = [["time", () => `${said(a.t[clock.row] / 100, 2)} s`]];
  if (a.reading) shown.push(["field", (i) => (a.reading[i] === UNKNOWN ? "unknown" : `${said(a.reading[i] / 100, 2)} µT`)]);
  if (a.trail) shown.push(["reading − map", (i) => (a.trail[i] === UNKNOWN ? "unknown" : `${said(a.trail[i], 0)} nT`)]);
  if (a.yaw) shown.push(["heading", (i) => (a.yaw[i] === UNKNOWN ? "unknown" : `${said((((a.yaw[i] / 10) % 360) + 360) % 360, 1)}°`)]);
  const list = at("now");
  const cells = shown.map(([name, text]) => {
    const cell = list.appendChild(document.createElement("div"));
    cell.append(element("dt", name), element("dd", ""));
    return [cell.lastChild, text];
  });
  clock.wanting.push(() => { for (const [cell, text] of cells) cell.textContent = text(clock.row); });
}

// Eleven moments of the run as a table, for readers without eyes on the charts.
function table(data) {
  const a = data.arrays, body = at("values");
  const columns = [["time [s]", a.t, 0.01, 2]];
  for (const chart of data.charts) {
    for (const line of chart.lines) columns.push([`${line.name} [${chart.unit}]`, a[line.column], chart.scale, chart.digits]);
  }
  const row = (tag, texts) => body.insertRow().append(...texts.map((text) => element(tag, text)));
  row("th", columns.map(([name]) => name));
  for (let k = 0; k <= 10; k++) {
    const i = Math.round((k / 10) * (a.t.length - 1));
    row("td", columns.map(([, values, scale, digits]) => (values[i] === UNKNOWN ? "unknown" : said(values[i] * scale, digits))));
  }
}

function element(tag, text, attributes = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

// ---- The bar: play, seek, pace, keys, colours of the page

function bar(data, clock) {
  const play = at("play"), seek = at("seek"), pace = at("pace"), text = at("time");
  seek.max = String(clock.end);
  play.addEventListener("click", () => clock.play(!clock.playing));
  seek.addEventListener("input", () => clock.seek(Number(seek.value)));
  pace.addEventListener("change", () => { clock.pace = Number(pace.value); });
  clock.pace = Number((pace.value = clock.end > 300 ? "20" : clock.end > 30 ? "5" : "1"));
  at("theme").addEventListener("click", () => {
    const dark = skyOf(at("canvas"))[0] < 0.5;
    document.documentElement.dataset.theme = dark ? "light" : "dark";
    clock.tell();
  });
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA|BUTTON|SUMMARY|A)$/.test(event.target.tagName)) return;
    const moves = { ArrowLeft: clock.now - 1, ArrowRight: clock.now + 1, Home: 0, End: clock.end };
    if (event.key === " ") clock.play(!clock.playing);
    else if (event.key in moves) clock.seek(moves[event.key]);
    else return;
    event.preventDefault();
  });
  clock.wanting.push(() => {
    seek.value = String(clock.now);
    seek.setAttribute("aria-valuetext", `${said(clock.now, 1)} s`);
    text.textContent = `${said(clock.now, 1)} / ${said(clock.end, 1)} s`;
    play.dataset.playing = String(clock.playing);
    play.setAttribute("aria-label", clock.playing ? "Pause" : "Play");
  });
}

// ---- Charts

const SVG = "http://www.w3.org/2000/svg";
const LEFT = 46, RIGHT = 10, TOP = 8;

function svg(tag, attributes, text) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function charts(data, clock) {
  const drawn = data.charts.map((chart, k) => new Chart(chart, data, clock, k));
  at("charts").append(...drawn.map((chart) => chart.box));
  const draw = () => { for (const chart of drawn) chart.draw(); };
  draw();
  new ResizeObserver(draw).observe(at("charts"));
  clock.wanting.push(() => { for (const chart of drawn) chart.point(); });
}

class Chart {
  constructor(chart, data, clock, number) {
    Object.assign(this, { chart, data, clock, number, last: number === data.charts.length - 1 });
    this.box = element("figure", "");
    const title = document.createElement("figcaption");
    title.append(element("b", `${chart.title} [${chart.unit}]${chart.band ? ", 90 % band" : ""}`));
    chart.lines.forEach((line, k) => title.append(element("span", line.name, { class: `key ${ink(k)}` })));
    this.value = element("output", "");
    title.append(this.value);
    this.svg = svg("svg", { role: "img", "aria-label": this.summary() });
    this.box.append(title, this.svg);
    const seek = (event) => {
      const box = this.svg.getBoundingClientRect();
      clock.seek(((event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT)) * clock.end);
    };
    this.svg.addEventListener("pointerdown", (event) => { this.svg.setPointerCapture(event.pointerId); seek(event); });
    this.svg.addEventListener("pointermove", (event) => { if (event.buttons) seek(event); });
  }
  column(name) { return this.data.arrays[name]; }
  summary() {
    const { chart } = this;
    const parts = chart.lines.map((line) => {
      const known = this.column(line.column).filter((v) => v !== UNKNOWN);
      const [low, high] = known.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
      return `${line.name} from ${said(low * chart.scale, chart.digits)} to ${said(high * chart.scale, chart.digits)} ${chart.unit}`;
    });
    return `${chart.title} over time: ${parts.join(", ")}`;
  }
  // Least and greatest value that the axis shows: all but the outermost .2 % of the values.
  range() {
    const all = [];
    const add = (name, sign) => { for (const v of this.column(name)) if (v !== UNKNOWN) all.push(sign * v); };
    for (const line of this.chart.lines) add(line.column, 1);
    if (this.chart.band) { add(this.chart.band, 1); add(this.chart.band, -1); }
    all.sort((a, b) => a - b);
    const out = Math.floor(all.length * 0.002);
    const low = all[out] * this.chart.scale, high = all[all.length - 1 - out] * this.chart.scale;
    const room = (high - low || 1) * 0.06;
    return [low - room, high + room];
  }
  draw() {
    const width = this.svg.clientWidth, height = this.svg.clientHeight;
    if (!width || !height) return;
    const bottom = height - (this.last ? 22 : 8), t = this.clock.t, end = this.clock.end || 1;
    const [low, high] = this.range();
    this.x = (seconds) => LEFT + (seconds / end) * (width - LEFT - RIGHT);
    this.y = (value) => bottom - ((value - low) / (high - low)) * (bottom - TOP);
    const parts = [], { chart } = this;
    const clip = `clip${this.chart.title.length}${chart.lines[0].column}`;
    const hole = svg("clipPath", { id: clip });
    hole.append(svg("rect", { x: LEFT, y: TOP, width: Math.max(1, width - LEFT - RIGHT), height: Math.max(1, bottom - TOP) }));
    parts.push(hole);
    if (this.column("lidar")) for (const [a, b] of spans(this.column("lidar"))) {
      const left = this.x(t[a] / 100), wide = this.x(t[b] / 100) - left;
      parts.push(svg("rect", { class: "lidar", x: left, y: TOP, width: wide, height: bottom - TOP }));
      if (!this.number && wide > 60) parts.push(svg("text", { x: left + 4, y: bottom - 4 }, "LiDAR on"));
    }
    for (const value of ticks(low, high, Math.max(5, Math.floor((bottom - TOP) / 36)))) {
      parts.push(svg("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: this.y(value), y2: this.y(value) }));
      parts.push(svg("text", { x: LEFT - 6, y: this.y(value) + 4, "text-anchor": "end" }, short(value)));
    }
    if (this.last) {
      const step = STEPS_S.find((s) => end / s <= (width - LEFT) / 70) || end;
      for (let s = 0; s <= end; s += step) {
        parts.push(svg("text", { x: this.x(s), y: height - 5, "text-anchor": s ? "middle" : "start" }, s ? short(s) : "0 s"));
      }
    }
    if (chart.band) parts.push(svg("path", { class: "band", "clip-path": `url(#${clip})`, d: this.bandPath() }));
    chart.lines.forEach((line, k) => parts.push(svg("path", { class: `line ${ink(k)}`, "clip-path": `url(#${clip})`, d: this.path(this.column(line.column), width) })));
    this.cursor = svg("line", { class: "cursor", y1: TOP, y2: bottom });
    this.dots = chart.lines.map((line, k) => svg("circle", { class: `dot ${ink(k)}`, r: 3.5 }));
    this.svg.replaceChildren(...parts, this.cursor, ...this.dots);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.point();
  }
  // A curve; where many rows share a pixel, their first, least, greatest and last value.
  path(column, width) {
    const t = this.clock.t, { scale } = this.chart, words = [];
    let pen = "M", i = 0;
    while (i < t.length) {
      const pixel = Math.floor(this.x(t[i] / 100) * 2);
      let j = i, low = i, high = i;
      for (; j < t.length && Math.floor(this.x(t[j] / 100) * 2) === pixel; j++) {
        if (column[j] === UNKNOWN) { low = -1; break; }
        if (column[j] < column[low]) low = j;
        if (column[j] > column[high]) high = j;
      }
      if (low < 0 || column[i] === UNKNOWN) { pen = "M"; i = Math.max(j, i) + 1; continue; }
      for (const k of [...new Set([i, Math.min(low, high), Math.max(low, high), j - 1])]) {
        words.push(`${pen}${this.x(t[k] / 100).toFixed(1)} ${this.y(column[k] * scale).toFixed(1)}`);
        pen = "L";
      }
      i = j;
    }
    return words.join("");
  }
  bandPath() {
    const t = this.clock.t, band = this.column(this.chart.band), { scale } = this.chart, up = [], down = [];
    const step = Math.max(1, Math.floor(t.length / 600));
    for (let i = 0; i < t.length; i += step) {
      if (band[i] === UNKNOWN) continue;
      const x = this.x(t[i] / 100).toFixed(1);
      up.push(`${x} ${this.y(band[i] * scale).toFixed(1)}`);
      down.push(`${x} ${this.y(-band[i] * scale).toFixed(1)}`);
    }
    return up.length ? `M${up.join("L")}L${down.reverse().join("L")}Z` : "";
  }
  point() {
    if (!this.cursor) return;
    const i = this.clock.row, { chart } = this, x = this.x(this.clock.t[i] / 100);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    chart.lines.forEach((line, k) => {
      const value = this.column(line.column)[i];
      this.dots[k].setAttribute("visibility", value === UNKNOWN ? "hidden" : "visible");
      this.dots[k].setAttribute("cx", x);
      this.dots[k].setAttribute("cy", this.y(value * chart.scale));
    });
    const texts = chart.lines.map((line) => said1(this.column(line.column)[i], chart));
    if (chart.band) texts.push(`± ${said1(this.column(chart.band)[i], chart)}`);
    this.value.textContent = `${texts.join(chart.band ? " " : " / ")} ${chart.unit}`;
  }
}

const ink = (k) => (k ? "model" : "data");
const said1 = (value, chart) => said(value === UNKNOWN ? value : value * chart.scale, chart.digits);
const short = (value) => said(Math.abs(value) < 1e-9 ? 0 : value, Math.abs(value) >= 10 || Number.isInteger(value) ? 0 : 2);

function ticks(low, high, most) {
  const step = niceStep((high - low) / most), values = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) values.push(k * step);
  return values;
}

// Stretches of rows in which a column is not 0.
function spans(column) {
  const found = [];
  for (let i = 0; i < column.length; i++) {
    if (!column[i]) continue;
    const first = i;
    while (i + 1 < column.length && column[i + 1]) i++;
    found.push([first, i]);
  }
  return found;
}

// ---- The stage: matrices by columns, as WebGL wants them

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };

function times(a, b) {
  const m = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    for (let k = 0; k < 4; k++) m[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  }
  return m;
}

function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
}

function looking(eye, target, up) {
  const z = unit(less(eye, target)), x = unit(cross(up, z)), y = cross(z, x);
  return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
}

function rigid([x, y, z, w], p) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    p[0], p[1], p[2], 1,
  ];
}

const about = (axis, angle) => [...axis.map((a) => a * Math.sin(angle / 2)), Math.cos(angle / 2)];
const SAME = rigid([0, 0, 0, 1], [0, 0, 0]);

const COMMON = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
vec3 seen(vec3 linear) { return pow(clamp(linear, 0., 1.), vec3(1. / 2.2)); }
`;
const BODY_V = `${COMMON}
in vec3 p; in vec3 n; in vec4 c;
uniform mat4 model, camera;
out vec3 place, normal; out vec4 colour;
void main() {
  vec4 world = model * vec4(p, 1.);
  place = world.xyz; normal = mat3(model) * n; colour = c;
  gl_Position = camera * world;
}`;

// What stands between the eye and the map is glass: it is drawn in the second pass, thinly.
const BODY_F = `${COMMON}
in vec3 place, normal; in vec4 colour;
uniform vec3 eye, sun; uniform vec4 rect; uniform mat4 light; uniform sampler2DShadow shade; uniform int pass, solid;
out vec4 ink;
void main() {
  bool glass = colour.a < .99;
  if (solid == 0 && place.z > .03 && eye.z > place.z + .01) {
    vec3 q = eye + (place - eye) * (eye.z / (eye.z - place.z));
    glass = glass || all(greaterThan(q.xy, rect.xy)) && all(lessThan(q.xy, rect.zw));
  }
  if (glass != (pass == 1)) discard;
  vec3 N = normalize(normal);
  if (dot(N, eye - place) < 0.) N = -N;
  vec3 s = (light * vec4(place + N * .02, 1.)).xyz * .5 + .5;
  float lit = 0.;
  if (all(lessThan(abs(s - .5), vec3(.5)))) {
    for (int i = 0; i < 4; i++) lit += .25 * texture(shade, s + vec3(vec2(i & 1, i >> 1) - .5, -.6) * .0007);
  } else lit = 1.;
  vec3 base = pow(colour.rgb, vec3(2.2));
  vec3 out_ = base * (.34 + .16 * N.z + .62 * lit * max(0., dot(N, sun)));
  ink = vec4(seen(out_), pass == 1 ? .11 : 1.);
}`;
const SHADE_F = `${COMMON}
in vec3 place, normal; in vec4 colour; out vec4 ink;
void main() { if (colour.a < .99) discard; ink = vec4(1.); }`;
const FLOOR_V = `${COMMON}
in vec2 p; uniform mat4 camera; uniform vec4 rect; out vec2 uv;
void main() { uv = p; gl_Position = camera * vec4(mix(rect.xy, rect.zw, p), .006, 1.); }`;
const FLOOR_F = `${COMMON}
in vec2 uv; uniform sampler2D values, colours; uniform vec2 size; uniform float step_; out vec4 ink;
void main() {
  vec2 v = texture(values, (uv * (size - 1.) + .5) / size).rg;
  if (v.g < .5) discard;
  float share = clamp(v.r, 0., 1.), line = v.r / step_, w = fwidth(line);
  float d = abs(fract(line - .5) - .5) / max(w, 1e-6);
  ink = vec4(texture(colours, vec2(share * 255. / 256. + .5 / 256., .5)).rgb * mix(.72, 1., smoothstep(.3, 1.3, d)), 1.);
}`;
const TRAIL_V = `${COMMON}
in vec2 p, across; in vec2 tv; uniform mat4 camera; uniform float half_, z; out vec2 t;
void main() { t = tv; gl_Position = camera * vec4(p + across * half_, z, 1.); }`;
const TRAIL_F = `${COMMON}
in vec2 t; uniform float now, most; uniform vec4 plain; uniform int later; uniform sampler2D colours; out vec4 ink;
void main() {
  if ((t.x > now) != (later == 1)) discard;
  ink = plain.a > 0. ? plain : t.y < -1e8 ? vec4(.6, .6, .6, 1.)
    : vec4(texture(colours, vec2(clamp(.5 + .5 * t.y / most, 0., 1.) * 255. / 256. + .5 / 256., .5)).rgb, 1.);
}`;

// Colour maps by nine or more equally spaced colours: viridis for fields, and one that diverges for differences.
const VIRIDIS = ["440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725"];
const DIVERGING = ["053061", "2166ac", "4393c3", "92c5de", "f7f7f7", "f4a582", "d6604d", "b2182b", "67001f"];
const gradient = (colours) => `linear-gradient(90deg, ${colours.map((c) => `#${c}`).join(", ")})`;

function stage(data, clock) {
  const canvas = at("canvas"), a = data.arrays, map = data.map;
  const gl = canvas.getContext("webgl2", { antialias: true, powerPreference: "low-power" });
  if (!gl) throw new Error("no WebGL 2");
  const make = programs(gl), lab = data.scene ? data.scene.bodies.map((body) => bodyOf(gl, make.body, body, a)) : [];
  const floor = map && floorOf(gl, make.floor, map, a);
  const path = a.x && trailOf(gl, make.trail, a);
  const shade = shadowOf(gl);
  const rect = map ? [map.x, map.y, map.x + (map.nx - 1) * map.dx, map.y + (map.ny - 1) * map.dy] : [0, 0, -1, -1];
  const box = around(data, lab, rect), sun = unit([0.35, -0.5, 1]);
  const camera = new Camera(canvas, box, rect, clock, a);
  const light = lightOf(box, sun);
  legend(data, clock, floor, path, camera);

  const models = () => lab.map((body) => {
    if (!body.moves) return SAME;
    const [x, y, yaw, wheel] = ["x", "y", "yaw", body.side].map((name) => a[name] && clock.value(a[name]));
    if (x === undefined || x === UNKNOWN) return null;
    const base = rigid(about([0, 0, 1], ((yaw || 0) * Math.PI) / 1800), [x / 1000, y / 1000, 0]);
    return body.axis ? times(times(base, rigid(body.q, body.p)), rigid(about(body.axis, (wheel || 0) / 100), [0, 0, 0])) : base;
  });
  const bodies = (program, placed, view) => {
    gl.useProgram(program.id);
    gl.uniformMatrix4fv(program.at("camera"), false, view);
    lab.forEach((body, k) => {
      if (!placed[k]) return;
      gl.uniformMatrix4fv(program.at("model"), false, placed[k]);
      if (program.at("solid")) gl.uniform1i(program.at("solid"), body.moves ? 1 : 0);
      gl.bindVertexArray(body.array);
      gl.drawArrays(gl.TRIANGLES, 0, body.count);
    });
  };
  const draw = () => {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const placed = models();
    gl.enable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, shade.buffer);
    gl.viewport(0, 0, shade.size, shade.size);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    bodies(make.shade, placed, light);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...skyOf(canvas), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { eye, view } = camera.now(width / height);
    const pass = (number) => {
      gl.useProgram(make.body.id);
      gl.uniform3fv(make.body.at("eye"), eye);
      gl.uniform3fv(make.body.at("sun"), sun);
      gl.uniform4fv(make.body.at("rect"), rect);
      gl.uniformMatrix4fv(make.body.at("light"), false, light);
      gl.uniform1i(make.body.at("shade"), 0);
      gl.uniform1i(make.body.at("pass"), number);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, shade.texture);
      bodies(make.body, placed, view);
    };
    pass(0);
    if (floor) floor.draw(view, rect);
    if (path) path.draw(view, clock.now, box.size);
    if (a.est_x) path.ellipse(view, clock, a, box.size);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    pass(1);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  };
  let waiting = false;
  const soon = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); root.dataset.frames = String(1 + Number(root.dataset.frames || 0)); });
  };
  camera.changed = soon;
  clock.wanting.push(soon);
  new ResizeObserver(soon).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", soon);
  canvas.addEventListener("webglcontextlost", () => { root.dataset.state = "still"; });
}

// Colour behind the lab, as the page's style has it.
const skyOf = (canvas) => getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).slice(0, 3).map((v) => v / 255);

function programs(gl) {
  const compiled = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, text);
    gl.compileShader(made);
    if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
    return made;
  };
  const program = (vertex, fragment) => {
    const id = gl.createProgram(), places = {};
    gl.attachShader(id, compiled(gl.VERTEX_SHADER, vertex));
    gl.attachShader(id, compiled(gl.FRAGMENT_SHADER, fragment));
    ["p", "n", "c"].forEach((name, k) => gl.bindAttribLocation(id, k, name)); // the same in every program of bodies
    gl.linkProgram(id);
    if (!gl.getProgramParameter(id, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(id));
    return { id, at: (name) => (name in places ? places[name] : (places[name] = gl.getUniformLocation(id, name))) };
  };
  return { body: program(BODY_V, BODY_F), shade: program(BODY_V, SHADE_F), floor: program(FLOOR_V, FLOOR_F), trail: program(TRAIL_V, TRAIL_F) };
}

// Fill a buffer and name it as an attribute of the vertex array that is bound.
function attribute(gl, place, array, width, type = gl.FLOAT, normalised = false) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
  if (place < 0) return;
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, width, type, normalised, 0, 0);
}

// Triangles of a body with normals that are smooth where faces meet at less than 40 degrees.
function bodyOf(gl, program, body, arrays) {
  const ints = arrays[`${body.name}.points`], faces = arrays[`${body.name}.faces`], n = ints.length / 3;
  const place = (i) => [0, 1, 2].map((k) => body.low[k] + (ints[k * n + i] / 65535) * body.size[k]);
  const welded = new Map(), same = new Int32Array(n), points = [];
  for (let i = 0; i < n; i++) {
    const key = ints[i] + 65536 * (ints[n + i] + 65536 * ints[2 * n + i]);
    if (!welded.has(key)) welded.set(key, welded.size);
    same[i] = welded.get(key);
    points.push(place(i));
  }
  const count = faces.length, flat = new Float32Array(count), meeting = Array.from({ length: welded.size }, () => []);
  for (let f = 0; f < count; f += 3) {
    const [p, q, r] = [0, 1, 2].map((k) => points[faces[f + k]]);
    flat.set(cross(less(q, p), less(r, p)), f);
    for (let k = 0; k < 3; k++) meeting[same[faces[f + k]]].push(f);
  }
  const p = new Float32Array(3 * count), normals = new Float32Array(3 * count), c = new Uint8Array(4 * count);
  const colours = arrays[`${body.name}.colours`], ends = arrays[`${body.name}.ends`];
  let part = 0;
  for (let f = 0; f < count; f += 3) {
    while (f / 3 >= ends[part]) part++;
    const own = flat.subarray(f, f + 3), length = Math.hypot(...own) || 1;
    for (let k = 0; k < 3; k++) {
      const corner = f + k, sum = [0, 0, 0];
      for (const other of meeting[same[faces[corner]]]) {
        const its = flat.subarray(other, other + 3);
        if (dot(own, its) >= 0.77 * length * Math.hypot(...its)) for (let m = 0; m < 3; m++) sum[m] += its[m];
      }
      p.set(points[faces[corner]], 3 * corner);
      normals.set(unit(sum), 3 * corner);
      c.set(colours.subarray(4 * part, 4 * part + 4), 4 * corner);
    }
  }
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  attribute(gl, 0, p, 3);
  attribute(gl, 1, normals, 3);
  attribute(gl, 2, c, 4, gl.UNSIGNED_BYTE, true);
  return { ...body, array, count };
}

function texture(gl, filter) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const [name, value] of [["MIN_FILTER", filter], ["MAG_FILTER", filter], ["WRAP_S", gl.CLAMP_TO_EDGE], ["WRAP_T", gl.CLAMP_TO_EDGE]]) {
    gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], value);
  }
  return made;
}

function ramp(gl, colours) {
  const made = texture(gl, gl.LINEAR), pixels = new Uint8Array(1024);
  const rgb = colours.map((c) => [0, 2, 4].map((k) => parseInt(c.slice(k, k + 2), 16)));
  for (let i = 0; i < 256; i++) {
    const x = (i / 255) * (rgb.length - 1), k = Math.min(rgb.length - 2, Math.floor(x));
    for (let m = 0; m < 3; m++) pixels[4 * i + m] = rgb[k][m] + (rgb[k + 1][m] - rgb[k][m]) * (x - k);
    pixels[4 * i + 3] = 255;
  }
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return made;
}

// The floor: the map at a heading as a texture, mixed from its harmonics.
function floorOf(gl, program, map, arrays) {
  const colours = ramp(gl, VIRIDIS), values = texture(gl, gl.LINEAR), n = map.nx * map.ny;
  const array = gl.createVertexArray(), mixed = new Float32Array(2 * n);
  const step = niceStep((map.high - map.low) / 15);
  gl.bindVertexArray(array);
  attribute(gl, gl.getAttribLocation(program.id, "p"), new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), 2);
  const turn = (yaw) => {
    const waves = [1];
    for (let k = 1; waves.length < map.waves; k++) waves.push(Math.cos(k * yaw), Math.sin(k * yaw));
    for (let i = 0; i < n; i++) {
      let b = 0;
      for (let k = 0; k < waves.length; k++) b += waves[k] * arrays.floor[k * n + i];
      mixed[2 * i] = (b - map.low) / (map.high - map.low);
      mixed[2 * i + 1] = arrays.known[i];
    }
    gl.bindTexture(gl.TEXTURE_2D, values);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RG16F, map.nx, map.ny, 0, gl.RG, gl.FLOAT, mixed);
  };
  turn(0);
  const draw = (view, rect) => {
    gl.useProgram(program.id);
    gl.uniformMatrix4fv(program.at("camera"), false, view);
    gl.uniform4fv(program.at("rect"), rect);
    gl.uniform2f(program.at("size"), map.nx, map.ny);
    gl.uniform1f(program.at("step_"), step / (map.high - map.low));
    [[values, "values"], [colours, "colours"]].forEach(([made, name], k) => {
      gl.activeTexture(gl.TEXTURE0 + k);
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.uniform1i(program.at(name), k);
    });
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(-2, -2);
    gl.bindVertexArray(array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  };
  return { draw, turn, step };
}

const niceStep = (raw) => { const power = 10 ** Math.floor(Math.log10(raw)); return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw); };

// The driven path as ribbons: up to now in colours of the reading minus the map, and from now on as a thin line.
function trailOf(gl, program, a) {
  const points = [];
  for (let i = 0; i < a.t.length; i++) {
    if (a.x[i] === UNKNOWN) continue;
    const last = points[points.length - 1], p = [a.x[i] / 1000, a.y[i] / 1000];
    if (!last || Math.hypot(p[0] - last.p[0], p[1] - last.p[1]) > 0.008) {
      points.push({ p, t: a.t[i] / 100, value: a.trail && a.trail[i] !== UNKNOWN ? a.trail[i] : -1e9 });
    }
  }
  const known = points.map((q) => Math.abs(q.value)).filter((v) => v < 1e8).sort((u, v) => u - v);
  const most = known.length ? niceStep(Math.max(1, known[Math.floor(0.99 * (known.length - 1))])) : 1;
  const ribbon = ribbonOf(gl, program, points), colours = ramp(gl, DIVERGING);
  const draw = (view, now, size) => {
    const wide = Math.max(0.022, size / 330);
    strips(view, ribbon, now, [[wide * 1.35, 0.011, [0.07, 0.08, 0.1, 1], 0], [wide, 0.013, [0, 0, 0, 0], 0], [wide / 4, 0.012, [1, 1, 1, 1], 1]]);
  };
  const strips = (view, shape, now, layers) => {
    gl.useProgram(program.id);
    gl.uniformMatrix4fv(program.at("camera"), false, view);
    gl.uniform1f(program.at("now"), now);
    gl.uniform1f(program.at("most"), most);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, colours);
    gl.uniform1i(program.at("colours"), 0);
    gl.bindVertexArray(shape.array);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    layers.forEach(([half, z, plain, later], k) => {
      gl.polygonOffset(-4 - 2 * k, -4 - 2 * k);
      gl.uniform1f(program.at("half_"), half);
      gl.uniform1f(program.at("z"), z);
      gl.uniform4fv(program.at("plain"), plain);
      gl.uniform1i(program.at("later"), later);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, shape.count);
    });
    gl.disable(gl.POLYGON_OFFSET_FILL);
  };
  // The estimate of a localizer: twice its standard deviations as an ellipse, and its place.
  const ellipse = (view, clock, arrays, size) => {
    const [x, y, u, v, turn] = ["est_x", "est_y", "est_a", "est_b", "est_turn"].map((name) => clock.value(arrays[name]) / 1000);
    if (arrays.est_x[clock.row] === UNKNOWN) return;
    const ring = (p, q, end) => Array.from({ length: 49 }, (_, k) => {
      const s = (k / 48) * 2 * Math.PI, e = [p * Math.cos(s), q * Math.sin(s)];
      return { p: [x + e[0] * Math.cos(turn) - e[1] * Math.sin(turn), y + e[0] * Math.sin(turn) + e[1] * Math.cos(turn)], t: 0, value: 0 };
    });
    const wide = Math.max(0.012, size / 500);
    gl.disable(gl.DEPTH_TEST);
    for (const [p, q] of [[2 * u, 2 * v], [wide, wide]]) {
      if (!(p > 0)) continue;
      const shape = ribbonOf(gl, program, ring(p, q));
      strips(view, shape, 1, [[wide, 0.015, [0.84, 0.2, 0.42, 1], 0]]);
      gl.deleteVertexArray(shape.array);
      shape.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
    }
    gl.enable(gl.DEPTH_TEST);
  };
  return { draw, ellipse, most };
}

function ribbonOf(gl, program, points) {
  const p = [], across = [], tv = [];
  points.forEach((point, i) => {
    const before = points[Math.max(0, i - 1)].p, after = points[Math.min(points.length - 1, i + 1)].p;
    const d = [after[0] - before[0], after[1] - before[1]], length = Math.hypot(...d) || 1;
    for (const sign of [1, -1]) {
      p.push(...point.p);
      across.push((-sign * d[1]) / length, (sign * d[0]) / length);
      tv.push(point.t, point.value);
    }
  });
  const array = gl.createVertexArray(), buffers = [];
  gl.bindVertexArray(array);
  for (const [name, values] of [["p", p], ["across", across], ["tv", tv]]) {
    attribute(gl, gl.getAttribLocation(program.id, name), new Float32Array(values), 2);
    buffers.push(gl.getParameter(gl.ARRAY_BUFFER_BINDING));
  }
  return { array, buffers, count: 2 * points.length };
}

function shadowOf(gl) {
  const size = 2048, made = texture(gl, gl.LINEAR), buffer = gl.createFramebuffer();
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, made, 0);
  gl.drawBuffers([gl.NONE]);
  return { size, texture: made, buffer };
}

// Box of what there is to see, its middle and its size.
function around(data, lab, rect) {
  const low = [Infinity, Infinity, 0], high = [-Infinity, -Infinity, 0.5];
  const add = (x, y) => { low[0] = Math.min(low[0], x); low[1] = Math.min(low[1], y); high[0] = Math.max(high[0], x); high[1] = Math.max(high[1], y); };
  for (const body of lab) if (!body.moves) {
    add(body.low[0], body.low[1]);
    add(body.low[0] + body.size[0], body.low[1] + body.size[1]);
    high[2] = Math.max(high[2], body.low[2] + body.size[2]);
  }
  if (data.map) { add(rect[0], rect[1]); add(rect[2], rect[3]); }
  const { x, y } = data.arrays;
  if (low[0] === Infinity && x) for (let i = 0; i < x.length; i++) if (x[i] !== UNKNOWN) add(x[i] / 1000, y[i] / 1000);
  const focus = data.map ? rect : [...low.slice(0, 2), ...high.slice(0, 2)];
  return { low, high, focus, size: Math.hypot(focus[2] - focus[0], focus[3] - focus[1]) };
}

// Orthographic view from the sun that holds the box.
function lightOf({ low, high }, sun) {
  const middle = low.map((v, k) => (v + high[k]) / 2), reach = Math.hypot(...less(high, low)) / 2;
  const view = looking(middle.map((v, k) => v + sun[k] * reach * 2), middle, [0, 1, 0]);
  const ortho = [1 / reach, 0, 0, 0, 0, 1 / reach, 0, 0, 0, 0, -1 / (2 * reach), 0, 0, 0, -1, 1];
  return times(ortho, view);
}

class Camera {
  constructor(canvas, box, rect, clock, arrays) {
    Object.assign(this, { box, clock, arrays, azimuth: -1.15, elevation: 0.62, mode: "orbit", zoom: 1, changed: () => {} });
    const { focus } = box;
    this.middle = [(focus[0] + focus[2]) / 2, (focus[1] + focus[3]) / 2, 0];
    this.shift = [0, 0];
    for (const button of at("views").children) button.addEventListener("click", () => this.take(button.value));
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); canvas.focus({ preventScroll: true }); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
      if (fingers.size === 2) {
        const [other] = [...fingers.values()].filter((f) => f.pointerId !== event.pointerId);
        const apart = (f) => Math.hypot(f.clientX - other.clientX, f.clientY - other.clientY) || 1;
        this.nearer(apart(event) / apart(before));
        this.pan(dx / 2, dy / 2, canvas);
      } else if (event.shiftKey || event.buttons & 6) this.pan(dx, dy, canvas);
      else this.turn(dx, dy);
      fingers.set(event.pointerId, event);
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return; // the page scrolls until the lab is touched
      event.preventDefault();
      this.nearer(Math.exp(-event.deltaY / 600));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.zoom = 1; this.shift = [0, 0]; this.changed(); });
    this.take("orbit");
  }
  take(mode) {
    this.mode = mode;
    for (const button of at("views").children) button.setAttribute("aria-pressed", String(button.value === mode));
    this.shift = [0, 0];
    this.zoom = 1;
    this.changed();
  }
  turn(dx, dy) {
    if (this.mode === "top") this.take("orbit");
    this.azimuth -= dx / 180;
    this.elevation = Math.min(1.5, Math.max(0.08, this.elevation + dy / 220));
    this.changed();
  }
  nearer(factor) {
    this.zoom = Math.min(20, Math.max(0.3, this.zoom * factor));
    this.changed();
  }
  pan(dx, dy, canvas) {
    const metre = (this.box.size * 1.1) / this.zoom / canvas.clientHeight, c = Math.cos(this.azimuth), s = Math.sin(this.azimuth);
    this.shift[0] += metre * (s * dx + c * dy * -1);
    this.shift[1] += metre * (-c * dx - s * dy);
    this.changed();
  }
  now(aspect) {
    const { box, arrays, clock } = this, angle = 0.7;
    const robot = arrays.x && clock.value(arrays.x) !== UNKNOWN && [clock.value(arrays.x) / 1000, clock.value(arrays.y) / 1000, 0.15];
    const wide = Math.max(1, 1.5 / aspect);
    let target = [this.middle[0] + this.shift[0], this.middle[1] + this.shift[1], 0];
    let far = (box.size * 1.02 * wide) / this.zoom, azimuth = this.azimuth, elevation = this.elevation, up = [0, 0, 1];
    if (this.mode === "top") {
      const [w, h] = [box.focus[2] - box.focus[0], box.focus[3] - box.focus[1]];
      far = (Math.max(h, w / aspect) * 1.12) / (2 * Math.tan(angle / 2)) / this.zoom;
      elevation = Math.PI / 2;
      up = [0, 1, 0];
    } else if (this.mode === "follow" && robot) {
      target = robot;
      far = Math.min(2.4, box.size / 3) / this.zoom;
      const yaw = arrays.yaw ? (clock.value(arrays.yaw) * Math.PI) / 1800 : 0;
      azimuth = yaw + Math.PI + (this.azimuth + 1.15);
      elevation = Math.max(0.2, this.elevation - 0.15);
    }
    const c = Math.cos(elevation);
    const eye = [target[0] + far * c * Math.cos(azimuth), target[1] + far * c * Math.sin(azimuth), target[2] + far * Math.sin(elevation)];
    const view = times(perspective(angle, aspect, far / 50, far * 4 + 60), looking(eye, target, up));
    return { eye, view };
  }
}

// Legend of the floor and of the trail, and the heading that the floor shows.
function legend(data, clock, floor, path, camera) {
  const { map, arrays: a } = data, slider = at("heading"), robots = at("robots");
  if (map) {
    at("floor-low").textContent = said(map.low / 1000, 1);
    at("floor-high").textContent = `${said(map.high / 1000, 1)} µT`;
    at("floor-ramp").style.background = gradient(VIRIDIS);
    at("floor-note").textContent = `Lines every ${said(floor.step, 0)} nT.${map.rms > 5 ? ` Drawn smooth over the heading, to ${map.rms} nT RMS.` : ""}`;
    let shown = null;
    const show = () => {
      const follow = robots.checked && a.yaw && clock.value(a.yaw) !== UNKNOWN;
      if (follow) slider.value = String(Math.round((((clock.value(a.yaw) / 10) % 360) + 360) % 360));
      at("heading-text").textContent = `${slider.value}°`;
      const yaw = Number(slider.value);
      if (yaw === shown) return;
      shown = yaw;
      floor.turn((yaw * Math.PI) / 180);
      camera.changed();
    };
    slider.addEventListener("input", () => { robots.checked = false; show(); });
    robots.addEventListener("change", show);
    clock.wanting.push(show);
  } else at("floor").hidden = true;
  if (path && a.trail) {
    at("trail-low").textContent = `−${said(path.most, 0)}`;
    at("trail-high").textContent = `+${said(path.most, 0)} nT`;
    at("trail-ramp").style.background = gradient(DIVERGING);
  } else at("trail").hidden = true;
}
})();
