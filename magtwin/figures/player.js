// Player: plays runs in their lab, from the block of data that player.py packs. Draws only what changes; fetches nothing.
(() => {
"use strict";

const UNKNOWN = -2147483648;
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 28800];
const ROBOTS = ["1b6fd0", "d9730d", "2a9d4a", "9c36b5", "c2255c", "0c8599"]; // what tells robots apart
const root = document.getElementById("player");
const at = (name) => root.querySelector(`[data-part="${name}"]`);

main().catch((error) => {
  root.dataset.state = "still";
  at("note").textContent = `This browser cannot play the run (${error.message}). The figures and tables are complete.`;
});

async function main() {
  const data = await unpack(document.getElementById("player-data").textContent);
  const clock = new Clock(data);
  for (const part of clock.robots.length ? [charts, bar, words, table, choice] : []) part(clock);
  if (root.dataset.scene === "lab") {
    try {
      stage(data, clock);
      root.dataset.state = "live";
    } catch (error) {
      at("note").textContent += ` The lab is not drawn: ${error.message}.`;
    }
  }
  const seek = () => { // #t=30&view=top&robot=bob&heading=90
    const told = new URLSearchParams(location.hash.slice(1));
    for (const [part, name] of [["views", "view"], ["choice", "robot"]]) at(part).querySelector(`[value="${CSS.escape(told.get(name) || "")}"]`)?.click();
    if (told.get("heading")) Object.assign(at("heading"), { value: told.get("heading") }).dispatchEvent(new Event("input"));
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

// The time that is shown [s], the robots that it moves, which of them is chosen, and who wants to know.
class Clock {
  constructor(data) {
    Object.assign(this, { now: 0, pace: 1, playing: false, wanting: [], choosing: [] });
    this.robots = data.robots.map((robot, k) => new Robot(robot, k, data.arrays, this));
    this.robot = this.robots[0];
    this.end = Math.max(0, ...this.robots.map(({ columns: { t } }) => t[t.length - 1] / 100));
  }
  seek(t) {
    this.now = Math.min(this.end, Math.max(0, t));
    this.tell();
  }
  tell() { for (const want of this.wanting) want(); }
  choose(robot) {
    this.robot = robot;
    for (const want of this.choosing) want();
    this.tell();
  }
  play(on) {
    this.playing = on;
    if (on && this.now >= this.end) this.now = 0;
    let before = performance.now();
    const step = (time) => {
      if (!this.playing) return;
      this.now = Math.min(this.end, this.now + (Math.max(0, time - before) / 1000) * this.pace);
      before = time;
      if (this.now >= this.end) this.playing = false;
      this.tell();
      if (this.playing) requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
    this.tell();
  }
}

class Robot {
  constructor({ name, charts }, k, arrays, clock) {
    Object.assign(this, { name, charts, number: k, clock, colour: ROBOTS[k % ROBOTS.length], columns: {} });
    for (const [key, array] of Object.entries(arrays)) if (key.startsWith(`${k}/`)) this.columns[key.slice(`${k}/`.length)] = array;
  }
  // Index of the last row at or before now.
  get row() {
    const { t } = this.columns, now = this.clock.now * 100 + 1e-6;
    let low = 0, high = t.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (t[middle] <= now) low = middle; else high = middle - 1;
    }
    return low;
  }
  // Value of a column between its rows; of headings and wheels too, as they are without jumps.
  value(name) {
    const column = this.columns[name], { t } = this.columns;
    if (!column) return UNKNOWN;
    const i = this.row, j = Math.min(i + 1, t.length - 1), gap = t[j] - t[i];
    if (column[i] === UNKNOWN || column[j] === UNKNOWN || gap <= 0) return column[i];
    return column[i] + (column[j] - column[i]) * Math.min(1, Math.max(0, (this.clock.now * 100 - t[i]) / gap));
  }
  in(name, scale) { const value = this.value(name); return value === UNKNOWN ? 0 : value * scale; }
  get place() { return this.value("x") === UNKNOWN ? null : ["x", "y", "z"].map((axis) => this.in(axis, 0.001)); }
  get yaw() { return this.in("yaw", Math.PI / 1800); }
}

// ---- Words

const numbers = (digits) => new Intl.NumberFormat("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
const said = (value, digits, unit = "") => (value === UNKNOWN ? "unknown" : numbers(digits).format(value).replace(/^-0(\.0*)?$/, "0$1").replace("-", "−") + unit);
const scaled = (value, scale, digits, unit = "") => said(value === UNKNOWN ? value : value * scale, digits, unit);
const degrees = (tenths) => (((tenths / 10) % 360) + 360) % 360;

function words(clock) {
  const shown = [["time", (a, i) => scaled(a.t[i], 0.01, 2, " s")],
    ["field", (a, i) => a.reading && scaled(a.reading[i], 0.01, 2, " µT")],
    ["reading − map", (a, i) => a.trail && scaled(a.trail[i], 1, 0, " nT")],
    ["heading", (a, i) => a.yaw && (a.yaw[i] === UNKNOWN ? "unknown" : said(degrees(a.yaw[i]), 1, "°"))]];
  const cells = shown.map(([name, text]) => {
    const cell = at("now").appendChild(element("div"));
    cell.append(element("dt", name), element("dd"));
    return [cell, text];
  });
  clock.wanting.push(() => {
    for (const [cell, text] of cells) {
      const now = text(clock.robot.columns, clock.robot.row);
      cell.hidden = !now;
      cell.lastChild.textContent = now || "";
    }
  });
}

// Eleven moments of the chosen robot as a table, for readers without eyes on the charts.
function table(clock) {
  const fill = () => {
    const body = at("values"), a = clock.robot.columns, columns = [["time [s]", a.t, 0.01, 2]];
    for (const { lines, unit, scale, digits } of clock.robot.charts) for (const { name, column } of lines) columns.push([`${name} [${unit}]`, a[column], scale, digits]);
    body.replaceChildren();
    const row = (tag, texts) => body.insertRow().append(...texts.map((text) => element(tag, text)));
    row("th", columns.map(([name]) => name));
    for (const cell of body.rows[0].cells) cell.scope = "col";
    for (let k = 0; k <= 10; k++) {
      const i = Math.round((k / 10) * (a.t.length - 1));
      row("td", columns.map(([, values, scale, digits]) => scaled(values[i], scale, digits)));
    }
  };
  clock.choosing.push(fill);
  fill();
}

// Which of several robots the charts are of.
function choice(clock) {
  if (clock.robots.length < 2) return;
  const buttons = clock.robots.map((robot) => {
    const button = element("button", robot.name, { value: robot.name, style: `--own: #${robot.colour}` });
    button.addEventListener("click", () => clock.choose(robot));
    return button;
  });
  const mark = () => buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(clock.robots[k] === clock.robot)));
  at("choice").append(...buttons);
  at("choice").hidden = false;
  clock.choosing.push(mark);
  mark();
}

function element(tag, text = "", attributes = {}, made = document.createElement(tag)) {
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

// ---- The bar: play, seek, pace, keys, colours of the page

function bar(clock) {
  const play = at("play"), seek = at("seek"), pace = at("pace"), text = at("time");
  seek.max = String(clock.end);
  play.addEventListener("click", () => clock.play(!clock.playing));
  seek.addEventListener("input", () => clock.seek(Number(seek.value)));
  pace.addEventListener("change", () => { clock.pace = Number(pace.value); });
  clock.pace = Number((pace.value = clock.end > 7200 ? "600" : clock.end > 300 ? "20" : clock.end > 30 ? "5" : "1"));
  at("theme").addEventListener("click", () => {
    document.documentElement.dataset.theme = skyOf(at("canvas"))[0] < 0.5 ? "light" : "dark";
    clock.tell();
  });
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA|BUTTON|SUMMARY|A)$/.test(event.target.tagName)) return;
    const moves = { ArrowLeft: clock.now - 1, ArrowRight: clock.now + 1, PageUp: clock.now - clock.end / 10, PageDown: clock.now + clock.end / 10, Home: 0, End: clock.end };
    if (event.key === " ") clock.play(!clock.playing);
    else if (event.key in moves) clock.seek(moves[event.key]);
    else return;
    event.preventDefault();
  });
  clock.wanting.push(() => {
    seek.value = String(clock.now);
    seek.setAttribute("aria-valuetext", said(clock.now, 1, " s"));
    text.textContent = `${said(clock.now, 1)} / ${said(clock.end, 1)} s`;
    play.dataset.playing = String(clock.playing);
    play.setAttribute("aria-label", clock.playing ? "Pause" : "Play");
  });
}

// ---- Charts

const LEFT = 46, RIGHT = 10, TOP = 8;
const svg = (tag, attributes, text) => element(tag, text, attributes, document.createElementNS("http://www.w3.org/2000/svg", tag));

function charts(clock) {
  let drawn = [];
  const make = () => {
    for (const chart of drawn) chart.box.remove();
    drawn = clock.robot.charts.map((chart, k) => new Chart(chart, clock.robot, clock, k));
    at("charts").append(...drawn.map((chart) => chart.box));
    draw();
  };
  const draw = () => { for (const chart of drawn) chart.draw(); };
  make();
  new ResizeObserver(draw).observe(at("charts"));
  clock.choosing.push(make);
  clock.wanting.push(() => { for (const chart of drawn) chart.point(); });
}

class Chart {
  constructor(chart, robot, clock, number) {
    Object.assign(this, { chart, robot, clock, number, last: number === robot.charts.length - 1 });
    this.box = element("figure");
    const title = element("figcaption");
    title.append(element("b", `${chart.title} [${chart.unit}]${chart.band ? ", 90 % band" : ""}`));
    this.values = chart.lines.map((line, k) => {
      title.append(element("span", `${line.name} `, { class: `key ${ink(k)}` }));
      return title.lastChild.appendChild(element("output", "", { "aria-live": "off" }));
    });
    this.svg = svg("svg", { role: "img", "aria-label": this.summary() });
    this.box.append(title, this.svg);
    for (const kind of ["pointerdown", "pointermove"]) this.svg.addEventListener(kind, (event) => {
      const box = this.svg.getBoundingClientRect();
      if (kind === "pointerdown") this.svg.setPointerCapture(event.pointerId);
      if (event.buttons) clock.seek(((event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT)) * clock.end);
    });
  }
  column(name) { return this.robot.columns[name]; }
  summary() {
    const { chart } = this;
    const parts = chart.lines.map((line) => {
      const known = this.column(line.column).filter((v) => v !== UNKNOWN);
      const [low, high] = known.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
      return `${line.name} from ${scaled(low, chart.scale, chart.digits)} to ${scaled(high, chart.scale, chart.digits)} ${chart.unit}`;
    });
    return `${chart.title} over time: ${parts.join(", ")}`;
  }
  // Least and greatest value that the axis shows: all but the outermost .2 % of the values.
  range() {
    const all = [], { chart } = this;
    const add = (name, sign) => { for (const v of this.column(name)) if (v !== UNKNOWN) all.push(sign * v); };
    for (const line of chart.lines) add(line.column, 1);
    if (chart.band) { add(chart.band, 1); add(chart.band, -1); }
    all.sort((a, b) => a - b);
    const out = Math.floor(all.length * 0.002);
    const low = all[out] * chart.scale, high = all[all.length - 1 - out] * chart.scale;
    const room = (high - low || 1) * 0.06;
    return [low - room, high + room];
  }
  draw() {
    const width = this.svg.clientWidth, height = this.svg.clientHeight;
    if (!width || !height) return;
    const bottom = height - (this.last ? 22 : 8), { t } = this.robot.columns, end = this.clock.end || 1;
    const [low, high] = this.range();
    this.x = (seconds) => LEFT + (seconds / end) * (width - LEFT - RIGHT);
    this.y = (value) => bottom - ((value - low) / (high - low)) * (bottom - TOP);
    const parts = [], { chart } = this, id = `clip${this.number}`, clip = { "clip-path": `url(#${id})` };
    const hole = svg("clipPath", { id });
    hole.append(svg("rect", { x: LEFT, y: TOP, width: Math.max(1, width - LEFT - RIGHT), height: Math.max(1, bottom - TOP) }));
    parts.push(hole);
    if (this.column("lidar")) for (const [a, b] of spans(this.column("lidar"))) {
      const left = this.x(t[a] / 100), wide = this.x(t[b] / 100) - left;
      parts.push(svg("rect", { class: "lidar", x: left, y: TOP, width: wide, height: bottom - TOP }));
      if (!this.number && wide > 60) parts.push(svg("text", { x: left + 4, y: bottom - 4 }, "LiDAR on"));
    }
    const step = niceStep((high - low) / Math.max(5, Math.floor((bottom - TOP) / 36)));
    for (let k = Math.ceil(low / step); k * step <= high; k++) {
      const value = k * step;
      parts.push(svg("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: this.y(value), y2: this.y(value) }));
      parts.push(svg("text", { x: LEFT - 6, y: this.y(value) + 4, "text-anchor": "end" }, short(value, step)));
    }
    if (this.last) {
      const wait = STEPS_S.find((s) => end / s <= (width - LEFT) / 70) || end;
      const [unit, name] = end >= 7200 ? [3600, "h"] : end >= 1200 ? [60, "min"] : [1, "s"];
      for (let k = 0; k * wait <= end; k++) {
        const where = { x: this.x(k * wait), y: height - 5, "text-anchor": k ? "middle" : "start" };
        if (where.x < width - 14) parts.push(svg("text", where, k ? short((k * wait) / unit, wait / unit) : `0 ${name}`));
      }
    }
    if (chart.band) parts.push(svg("path", { class: "band", ...clip, d: this.bandPath() }));
    chart.lines.forEach((line, k) => parts.push(svg("path", { class: `line ${ink(k)}`, ...clip, d: this.path(this.column(line.column)) })));
    this.cursor = svg("line", { class: "cursor", y1: TOP, y2: bottom });
    this.dots = chart.lines.map((line, k) => svg("circle", { class: `dot ${ink(k)}`, r: 3.5, ...clip }));
    this.svg.replaceChildren(...parts, this.cursor, ...this.dots);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.point();
  }
  // A curve with gaps; where many rows share a pixel, their first, least, greatest and last value.
  path(column) {
    const { t } = this.robot.columns, { scale } = this.chart, words = [];
    for (const [first, last] of spans(column, UNKNOWN)) {
      let pen = "M";
      for (let i = first; i <= last;) {
        const pixel = Math.floor(this.x(t[i] / 100) * 2);
        let j = i, low = i, high = i;
        for (; j <= last && Math.floor(this.x(t[j] / 100) * 2) === pixel; j++) {
          if (column[j] < column[low]) low = j;
          if (column[j] > column[high]) high = j;
        }
        for (const k of new Set([i, Math.min(low, high), Math.max(low, high), j - 1])) {
          words.push(`${pen}${this.x(t[k] / 100).toFixed(1)} ${this.y(column[k] * scale).toFixed(1)}`);
          pen = "L";
        }
        i = j;
      }
    }
    return words.join("");
  }
  bandPath() {
    const { t } = this.robot.columns, band = this.column(this.chart.band), { scale } = this.chart;
    const step = Math.max(1, Math.floor(t.length / 600));
    return spans(band, UNKNOWN).map(([first, last]) => {
      const rows = [];
      for (let i = first; i < last; i += step) rows.push(i);
      const edge = (sign) => [...rows, last].map((i) => `${this.x(t[i] / 100).toFixed(1)} ${this.y(sign * band[i] * scale).toFixed(1)}`);
      return `M${edge(1).join("L")}L${edge(-1).reverse().join("L")}Z`;
    }).join("");
  }
  point() {
    if (!this.cursor) return;
    const i = this.robot.row, { chart } = this, x = this.x(this.robot.columns.t[i] / 100);
    for (const name of ["x1", "x2"]) this.cursor.setAttribute(name, x);
    chart.lines.forEach((line, k) => {
      const value = this.column(line.column)[i];
      this.dots[k].setAttribute("visibility", value === UNKNOWN ? "hidden" : "visible");
      this.dots[k].setAttribute("cx", x);
      this.dots[k].setAttribute("cy", this.y(value * chart.scale));
      const text = (name) => scaled(this.column(name)[i], chart.scale, chart.digits);
      this.values[k].textContent = text(line.column) + (chart.band ? ` ± ${text(chart.band)}` : "");
    });
  }
}

const ink = (k) => (k ? "model" : "data");
const short = (value, step) => said(value, Math.max(0, Math.ceil(-Math.log10(step) - 1e-9))); // in the digits of a step

// Stretches of rows in which a column is another number than `none`: first and last row of each.
function spans(column, none = 0) {
  const found = [];
  for (let i = 0; i < column.length; i++) {
    if (column[i] === none) continue;
    const first = i;
    while (i + 1 < column.length && column[i + 1] !== none) i++;
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
  return [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0, ...p, 1];
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
uniform vec3 eye, sun; uniform vec4 rect; uniform mat4 light; uniform sampler2DShadow shade; uniform float pass, solid;
out vec4 ink;
void main() {
  bool glass = colour.a < .99;
  if (solid < .5 && place.z > .03 && eye.z > place.z + .01) {
    vec3 q = eye + (place - eye) * (eye.z / (eye.z - place.z));
    glass = glass || all(greaterThan(q.xy, rect.xy)) && all(lessThan(q.xy, rect.zw));
  }
  if (glass != (pass > .5)) discard;
  vec3 N = normalize(normal);
  if (dot(N, eye - place) < 0.) N = -N;
  vec3 s = (light * vec4(place + N * .02, 1.)).xyz * .5 + .5;
  float lit = 0.;
  if (all(lessThan(abs(s - .5), vec3(.5)))) {
    for (int i = 0; i < 4; i++) lit += .25 * texture(shade, s + vec3(vec2(i & 1, i >> 1) - .5, -.6) * .0007);
  } else lit = 1.;
  vec3 base = pow(colour.rgb, vec3(2.2));
  vec3 out_ = base * (.34 + .16 * N.z + .62 * lit * max(0., dot(N, sun)));
  ink = vec4(seen(out_), pass > .5 ? .11 : 1.);
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
in vec2 t; uniform float now, most, later; uniform vec4 plain; uniform sampler2D colours; out vec4 ink;
void main() {
  if ((t.x > now) != (later > .5)) discard;
  ink = plain.a > 0. ? plain : t.y < -1e8 ? vec4(.6, .6, .6, 1.)
    : vec4(texture(colours, vec2(clamp(.5 + .5 * t.y / most, 0., 1.) * 255. / 256. + .5 / 256., .5)).rgb, 1.);
}`;

// Colour maps by nine or more equally spaced colours: viridis for fields, and one that diverges for differences.
const VIRIDIS = ["440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725"];
const DIVERGING = ["053061", "2166ac", "4393c3", "92c5de", "f7f7f7", "f4a582", "d6604d", "b2182b", "67001f"];

function stage(data, clock) {
  const canvas = at("canvas"), { map, arrays } = data, { robots } = clock;
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, powerPreference: "low-power" });
  if (!gl) throw new Error("no WebGL 2");
  const make = programs(gl), lab = data.bodies.map((body) => bodyOf(gl, body, arrays));
  const floor = map && floorOf(gl, make.floor, map, arrays), trails = trailsOf(gl, make.trail, robots, map || lab.length ? [1, 1, 1, 1] : [0.5, 0.54, 0.58, 1]), shade = shadowOf(gl);
  const rect = map ? [map.x, map.y, map.x + (map.nx - 1) * map.dx, map.y + (map.ny - 1) * map.dy] : [0, 0, -1, -1];
  const box = around(lab, robots, map && rect), sun = unit([0.35, -0.5, 1]), light = lightOf(box, sun);
  const camera = new Camera(canvas, box, clock);
  legend(map, clock, floor, trails, camera);

  const models = () => lab.map((body) => {
    if (body.robot === undefined) return SAME;
    const robot = robots[body.robot], { place } = robot;
    if (!place) return null;
    const base = rigid(about([0, 0, 1], robot.yaw), place);
    return body.axis ? times(times(base, rigid(body.q, body.p)), rigid(about(body.axis, robot.in(body.side, 0.01)), [0, 0, 0])) : base;
  });
  const bodies = (program, placed, view) => {
    lab.forEach((body, k) => {
      if (!placed[k]) return;
      use(gl, program, { camera: view, model: placed[k], solid: body.solid || 0 });
      gl.bindVertexArray(body.array);
      gl.drawArrays(gl.TRIANGLES, 0, body.count);
    });
  };
  const draw = () => {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const placed = models(), { eye, view } = camera.now(width / height);
    gl.enable(gl.DEPTH_TEST);
    if (shade.time !== clock.now) { // only what moves changes the shadows
      shade.time = clock.now;
      gl.bindFramebuffer(gl.FRAMEBUFFER, shade.buffer);
      gl.viewport(0, 0, shade.size, shade.size);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      bodies(make.shade, placed, light);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(...skyOf(canvas), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const pass = (number) => {
      use(gl, make.body, { eye, sun, rect, light, pass: number }, { shade: shade.texture });
      bodies(make.body, placed, view);
    };
    pass(0);
    if (floor) floor.draw(view, rect);
    trails.draw(view, clock.now, box.size);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    pass(1);
    trails.estimates(view, box.size);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    root.dataset.frames = String(1 + Number(root.dataset.frames || 0));
  };
  let waiting = false;
  const soon = () => {
    if (!waiting) requestAnimationFrame(() => { waiting = false; draw(); });
    waiting = true;
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
  const program = (...texts) => {
    const id = gl.createProgram(), places = {};
    texts.forEach((text, k) => {
      const made = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(made, text);
      gl.compileShader(made);
      if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
      gl.attachShader(id, made);
    });
    [["p", 0], ["n", 1], ["across", 1], ["c", 2], ["tv", 2]].forEach(([name, k]) => gl.bindAttribLocation(id, k, name));
    gl.linkProgram(id);
    if (!gl.getProgramParameter(id, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(id));
    return { id, at: (name) => (name in places ? places[name] : (places[name] = gl.getUniformLocation(id, name))) };
  };
  return { body: program(BODY_V, BODY_F), shade: program(BODY_V, SHADE_F), floor: program(FLOOR_V, FLOOR_F), trail: program(TRAIL_V, TRAIL_F) };
}

// A vertex array of attributes: each an array, the numbers of a vertex, and whether they are colours.
function verticesOf(gl, attributes) {
  const made = gl.createVertexArray();
  gl.bindVertexArray(made);
  attributes.forEach(([array, width, colours], k) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(k, width, colours ? gl.UNSIGNED_BYTE : gl.FLOAT, Boolean(colours), 0, 0);
  });
  return made;
}

// Take a program, with the numbers, vectors and matrices of its uniforms, and its textures.
function use(gl, program, values, textures = {}) {
  gl.useProgram(program.id);
  for (const [name, value] of Object.entries(values)) {
    if (value.length === 16) gl.uniformMatrix4fv(program.at(name), false, value);
    else gl[`uniform${value.length || 1}fv`](program.at(name), value.length ? value : [value]);
  }
  Object.entries(textures).forEach(([name, made], k) => {
    gl.activeTexture(gl.TEXTURE0 + k);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.uniform1i(program.at(name), k);
  });
}

// Triangles of a body with normals that are smooth where faces meet at less than 40 degrees.
function bodyOf(gl, body, arrays) {
  const [ints, faces, colours, ends] = ["points", "faces", "colours", "ends"].map((name) => arrays[`${body.name}.${name}`]);
  const n = ints.length / 3, count = faces.length, welded = new Map(), same = new Int32Array(n), points = [];
  for (let i = 0; i < n; i++) {
    const key = ints[i] + 65536 * (ints[n + i] + 65536 * ints[2 * n + i]);
    if (!welded.has(key)) welded.set(key, welded.size);
    same[i] = welded.get(key);
    points.push([0, 1, 2].map((k) => body.low[k] + (ints[k * n + i] / 65535) * body.size[k]));
  }
  const across = [], meeting = Array.from({ length: welded.size }, () => []); // normals of faces, by the points where they meet
  for (let f = 0; f < count; f += 3) {
    const [p, q, r] = [0, 1, 2].map((k) => points[faces[f + k]]), normal = cross(less(q, p), less(r, p));
    for (const normals of [across, ...[0, 1, 2].map((k) => meeting[same[faces[f + k]]])]) normals.push(normal);
  }
  const p = new Float32Array(3 * count), normals = new Float32Array(3 * count), c = new Uint8Array(4 * count);
  for (let f = 0, part = 0; f < count; f += 3) {
    while (f / 3 >= ends[part]) part++;
    const own = across[f / 3], length = Math.sqrt(dot(own, own)) || 1;
    for (let corner = f; corner < f + 3; corner++) {
      const sum = [0, 0, 0];
      for (const its of meeting[same[faces[corner]]]) {
        if (dot(own, its) >= 0.77 * length * Math.sqrt(dot(its, its))) for (let m = 0; m < 3; m++) sum[m] += its[m];
      }
      p.set(points[faces[corner]], 3 * corner);
      normals.set(unit(sum), 3 * corner);
      c.set(colours.subarray(4 * part, 4 * part + 4), 4 * corner);
    }
  }
  return { ...body, array: verticesOf(gl, [[p, 3], [normals, 3], [c, 4, true]]), count };
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.LINEAR);
  for (const name of ["WRAP_S", "WRAP_T"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
  return made;
}

const rgbOf = (colour) => [0, 2, 4].map((k) => parseInt(colour.slice(k, k + 2), 16));

function ramp(gl, colours) {
  const made = texture(gl), pixels = new Uint8Array(1024), rgb = colours.map(rgbOf);
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
  const colours = ramp(gl, VIRIDIS), values = texture(gl), n = map.nx * map.ny;
  const mixed = new Float32Array(2 * n), step = niceStep((map.high - map.low) / 15);
  const square = verticesOf(gl, [[new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), 2]]);
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
    use(gl, program, { camera: view, rect, size: [map.nx, map.ny], step_: step / (map.high - map.low) }, { values, colours });
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(-2, -2);
    gl.bindVertexArray(square);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  };
  return { draw, turn, step };
}

const niceStep = (raw) => { const power = 10 ** Math.floor(Math.log10(raw)); return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw); };

// Driven paths as ribbons: up to now in colours of the reading minus the map, and from now on as a thin line.
function trailsOf(gl, program, robots, later) {
  const colours = ramp(gl, DIVERGING), known = robots.flatMap(({ columns: { trail } }) => [...(trail || [])]);
  const sizes = known.filter((v) => v !== UNKNOWN).map(Math.abs).sort((u, v) => u - v);
  const most = sizes.length ? niceStep(Math.max(1, sizes[Math.floor(0.99 * (sizes.length - 1))])) : 1;
  const paths = robots.filter((robot) => robot.columns.x).map((robot) => {
    const edge = robots.length > 1 ? rgbOf(robot.colour).map((v) => v / 255) : [0.07, 0.08, 0.1];
    return { edge, ...ribbonOf(gl, robot.columns) };
  });
  const begin = (camera, now) => use(gl, program, { camera, now, most }, { colours });
  const strip = (count, half_, z, plain, later = 0) => {
    use(gl, program, { half_, z, plain, later });
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, count);
  };
  const draw = (view, now, size) => {
    const wide = Math.max(0.022, size / 330), around = paths.length > 1 ? 1.9 : 1.35;
    begin(view, now);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    for (const { array, count, edge } of paths) {
      gl.bindVertexArray(array);
      [[wide * around, 0.011, [...edge, 1]], [wide, 0.013, [0, 0, 0, 0]], [wide / 4, 0.012, later, 1]].forEach((layer, k) => {
        gl.polygonOffset(-4 - 2 * k, -4 - 2 * k);
        strip(count, ...layer);
      });
    }
    gl.disable(gl.POLYGON_OFFSET_FILL);
  };
  // The estimates of a localizer: each as its 90 % ellipse and its place, over everything.
  const ring = verticesOf(gl, [[new Float32Array(196), 2]]), buffer = gl.getParameter(gl.ARRAY_BUFFER_BINDING);
  const estimates = (view, size) => {
    begin(view, 1);
    gl.bindVertexArray(ring);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.disable(gl.DEPTH_TEST);
    for (const robot of robots) {
      if (robot.value("est_x") === UNKNOWN) continue;
      const [x, y, a, b] = ["est_x", "est_y", "est_a", "est_b"].map((name) => robot.in(name, 0.001));
      const turn = robot.columns.est_turn[robot.row] / 1000, c = Math.cos(turn), s = Math.sin(turn), wide = Math.max(0.015, size / 450);
      for (const [p, q, inner, opacity] of [[a, b, 0, 0.25], [a, b, 1, 1], [wide * 1.6, wide * 1.6, 0, 1]]) {
        gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(Array.from({ length: 98 }, (_, k) => {
          const angle = ((k >> 1) / 48) * 2 * Math.PI, e = [p * Math.cos(angle), q * Math.sin(angle)];
          const share = k & 1 ? Math.max(0, 1 - wide / (Math.hypot(...e) || 1)) * inner : 1;
          return [x + share * (c * e[0] - s * e[1]), y + share * (s * e[0] + c * e[1])];
        }).flat()), gl.DYNAMIC_DRAW);
        strip(98, 0, 0.015, [0.84, 0.13, 0.4, opacity]);
      }
    }
    gl.enable(gl.DEPTH_TEST);
  };
  return { draw, estimates, most };
}

function ribbonOf(gl, { x, y, t, trail }) {
  const points = [], p = [], across = [], tv = [];
  for (let i = 0; i < t.length; i++) {
    const last = points[points.length - 1], place = [x[i] / 1000, y[i] / 1000];
    if (x[i] === UNKNOWN || (last && Math.hypot(place[0] - last.place[0], place[1] - last.place[1]) <= 0.008)) continue;
    points.push({ place, tv: [t[i] / 100, trail && trail[i] !== UNKNOWN ? trail[i] : -1e9] });
  }
  points.forEach((point, i) => {
    const [before, after] = [points[Math.max(0, i - 1)].place, points[Math.min(points.length - 1, i + 1)].place];
    const d = [after[0] - before[0], after[1] - before[1]], length = Math.hypot(...d) || 1;
    for (const sign of [1, -1]) {
      p.push(...point.place);
      across.push((-sign * d[1]) / length, (sign * d[0]) / length);
      tv.push(...point.tv);
    }
  });
  return { array: verticesOf(gl, [p, across, tv].map((values) => [new Float32Array(values), 2])), count: 2 * points.length };
}

function shadowOf(gl) {
  const size = 2048, made = texture(gl), buffer = gl.createFramebuffer();
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, made, 0);
  gl.drawBuffers([gl.NONE]);
  return { size, texture: made, buffer };
}

// Box of what there is to see, and the middle and the size of what matters in it: the map, or else all.
function around(lab, robots, rect) {
  const low = [Infinity, Infinity, 0], high = [-Infinity, -Infinity, 0.5];
  const add = (...place) => place.forEach((v, k) => { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); });
  for (const body of lab) if (body.robot === undefined) [body.low, body.low.map((v, k) => v + body.size[k])].forEach((v) => add(...v));
  if (rect) [rect.slice(0, 2), rect.slice(2)].forEach((v) => add(...v));
  for (const { columns: { x, y } } of robots) if (!rect && !lab.length && x) x.forEach((v, i) => v === UNKNOWN || add(v / 1000, y[i] / 1000));
  low[2] = 0;
  const focus = rect || [...low.slice(0, 2), ...high.slice(0, 2)];
  const rise = rect || !lab.length ? 0 : high[2]; // what stands on a map need not be seen whole
  return { low, high, focus, rise, size: Math.max(0.5, 1.2 * rise + Math.hypot(focus[2] - focus[0], focus[3] - focus[1])) };
}

// Orthographic view from the sun that holds the box.
function lightOf({ low, high }, sun) {
  const middle = low.map((v, k) => (v + high[k]) / 2), reach = Math.hypot(...less(high, low)) / 2;
  const view = looking(middle.map((v, k) => v + sun[k] * reach * 2), middle, [0, 1, 0]);
  return times([1 / reach, 0, 0, 0, 0, 1 / reach, 0, 0, 0, 0, -1 / (2 * reach), 0, 0, 0, -1, 1], view);
}

class Camera {
  constructor(canvas, box, clock) {
    Object.assign(this, { box, clock, azimuth: -1.15, elevation: 0.62, changed: () => {} });
    this.middle = [(box.focus[0] + box.focus[2]) / 2, (box.focus[1] + box.focus[3]) / 2];
    for (const button of at("views").children) button.addEventListener("click", () => this.take(button.value));
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(fingers.set(event.pointerId, event) && event.pointerId);
      canvas.focus({ preventScroll: true });
    });
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
    canvas.addEventListener("dblclick", () => this.take(this.mode));
    this.take("orbit");
  }
  take(mode) {
    for (const button of at("views").children) button.setAttribute("aria-pressed", String(button.value === mode));
    Object.assign(this, { mode, shift: [0, 0], zoom: 1 });
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
    const azimuth = this.mode === "top" ? -Math.PI / 2 : this.azimuth, c = Math.cos(azimuth), s = Math.sin(azimuth);
    const metre = (this.box.size * 1.1) / this.zoom / canvas.clientHeight;
    this.shift[0] += metre * (s * dx - c * dy);
    this.shift[1] += metre * (-c * dx - s * dy);
    this.changed();
  }
  now(aspect) {
    const { box, clock: { robot } } = this, angle = 0.7, place = robot && robot.place;
    let target = [this.middle[0] + this.shift[0], this.middle[1] + this.shift[1], box.rise / 2], up = [0, 0, 1];
    let far = (box.size * 1.02 * Math.max(1, 1.5 / aspect)) / this.zoom, { azimuth, elevation } = this;
    if (this.mode === "top") {
      const [w, h] = [box.focus[2] - box.focus[0], box.focus[3] - box.focus[1]];
      far = (Math.max(h, w / aspect, 0.5) * 1.12) / (2 * Math.tan(angle / 2)) / this.zoom;
      azimuth = -Math.PI / 2;
      elevation = Math.PI / 2;
      up = [0, 1, 0];
    } else if (this.mode === "follow" && place) {
      target = [place[0], place[1], place[2] + 0.15];
      far = Math.min(2.4, box.size / 3) / this.zoom;
      azimuth = robot.yaw + Math.PI + (azimuth + 1.15);
      elevation = Math.max(0.2, elevation - 0.15);
    }
    const c = Math.cos(elevation), way = [c * Math.cos(azimuth), c * Math.sin(azimuth), Math.sin(elevation)];
    const eye = target.map((v, k) => v + far * way[k]);
    return { eye, view: times(perspective(angle, aspect, far / 50, far * 4 + 60), looking(eye, target, up)) };
  }
}

// Legend of the floor and of the trail, and the heading that the floor shows.
function legend(map, clock, floor, trails, camera) {
  const slider = at("heading"), own = at("own");
  const scale = (part, low, high, colours) => {
    at(`${part}-low`).textContent = low;
    at(`${part}-high`).textContent = high;
    at(`${part}-ramp`).style.background = `linear-gradient(90deg, ${colours.map((c) => `#${c}`).join(", ")})`;
  };
  at("floor").hidden = !map;
  at("trail").hidden = !clock.robots.some(({ columns }) => columns.trail);
  at("estimate").hidden = !clock.robots.some(({ columns }) => columns.est_x);
  own.parentElement.hidden = !clock.robots.some(({ columns }) => columns.yaw);
  scale("trail", `−${said(trails.most, 0)}`, `+${said(trails.most, 0)} nT`, DIVERGING);
  if (!map) return;
  scale("floor", said(map.low / 1000, 1), said(map.high / 1000, 1, " µT"), VIRIDIS);
  at("floor-note").textContent = `Lines every ${said(floor.step, 0)} nT.${map.rms > 5 ? ` Drawn smooth over the heading, to ${map.rms} nT RMS.` : ""}`;
  let shown = null;
  const show = () => {
    const yaw = clock.robot ? clock.robot.value("yaw") : UNKNOWN;
    if (own.checked && yaw !== UNKNOWN) slider.value = String(Math.round(degrees(yaw)) % 360);
    at("heading-text").textContent = `${slider.value}°`;
    if (slider.value === shown) return;
    shown = slider.value;
    floor.turn((Number(shown) * Math.PI) / 180);
    camera.changed();
  };
  slider.addEventListener("input", () => { own.checked = false; show(); });
  own.addEventListener("change", show);
  clock.wanting.push(show);
}
})();
