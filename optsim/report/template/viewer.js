// The viewer: truth, methods and differences of measured light, slot by slot.
const view = document.getElementById("view");
const canvas = view.querySelector("canvas");
const at = (id) => document.getElementById(id);
const METHODS = Object.keys(record.frames[0].methods);
const NAMES = ["", ...METHODS];
const MARKS = ["", "moving", "open", "given up"];
const [GREEN, RED, YELLOW] = [[18, 166, 131], [224, 69, 123], [242, 182, 50]];
const LEGENDS = {
  moving: [[GREEN, "moves, held moving"], [RED, "moves, held static"], [YELLOW, "static, held moving"]],
  open: [[GREEN, "open in this slot"]],
};
const START = Math.log2(record.white_cd_m2 / record.start_white_cd_m2);

// All that is shown; "show" buttons of the page set parts of it.
const state = {
  frame: record.frames[0].index,
  slot: Math.floor(record.slots / 2),
  left: METHODS[0],
  right: "",
  view: "slider",
  stops: START,
  cut: 0.5,
  mark: "",
  limit: 2,
  zoom: 0, // CSS pixels a panel pixel; 0 fits the stage
  row: record.rows / 2,
  col: record.cols / 2,
  box: null,
};
let shown = null; // videos of the last drawing
let blinkRight = false;
let colours = null;
let coloursOf = null;

const label = (name) => name || "truth";
const fitZoom = () => Math.min(canvas.clientWidth / record.cols, canvas.clientHeight / record.rows);
const zoom = () => Math.max(state.zoom, fitZoom());
const clamp = (value, low, high) => Math.max(low, Math.min(high, value));

function set(parts) {
  Object.assign(state, parts);
  state.slot = clamp(Math.round(state.slot), 0, record.slots - 1);
  state.stops = clamp(state.stops, START - 16, START + 10);
  state.cut = clamp(state.cut, 0, 1);
  state.zoom = state.zoom <= fitZoom() ? 0 : Math.min(state.zoom, 64);
  return draw();
}

// A panel pixel's centre and zoom from a rectangle: row, column, height, width.
function frameBox(box) {
  const [row, col, height, width] = box;
  const zoom = 0.4 * Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
  return { box, zoom, row: row + height / 2, col: col + width / 2 };
}

function showState(wanted) {
  const parts = { box: null, zoom: 0, mark: "", stops: START, ...wanted };
  if (wanted.white) parts.stops = Math.log2(record.white_cd_m2 / wanted.white);
  if (wanted.box) Object.assign(parts, frameBox(wanted.box));
  delete parts.white;
  at("viewer").scrollIntoView({ block: "start" });
  view.focus({ preventScroll: true });
  return set(parts);
}

let turn = 0;
async function draw() {
  const mine = ++turn;
  controls();
  try {
    const [left, right] = await Promise.all([state.left, state.right].map((name) => video(state.frame, name)));
    const truth = state.mark === "moving" ? await video(state.frame, "") : null;
    if (mine !== turn) return;
    shown = { left, right };
    paint(left, right, truth);
    view.dataset.drawn = String(mine);
  } catch (error) {
    at("readout").textContent = error.message;
  }
}

function paint(left, right, truth) {
  const ratio = devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = false;
  const place = [originX(), originY(), record.cols * zoom(), record.rows * zoom()].map((length) => length * ratio);
  const put = (picture) => context.drawImage(picture, ...place);
  if (state.view === "difference") put(picture((i, sample) => differing(left, right, i, sample)));
  else {
    const rightAlone = state.view === "right" || (state.view === "blink" && blinkRight);
    const first = rightAlone ? right : left;
    if (state.view === "slider") put(light(right, truth));
    context.save();
    context.beginPath();
    context.rect(0, 0, state.view === "slider" ? edge() * ratio : canvas.width, canvas.height);
    context.clip();
    context.clearRect(0, 0, canvas.width, canvas.height);
    put(light(first, truth));
    context.restore();
  }
  if (state.box) {
    const [row, col, height, width] = state.box;
    context.strokeStyle = "#ff2bd6";
    context.lineWidth = 2 * ratio;
    const corner = [originX() + col * zoom(), originY() + row * zoom()];
    context.strokeRect(...[...corner, width * zoom(), height * zoom()].map((length) => length * ratio));
  }
}

// Place of the picture on the stage, CSS pixels; a picture larger than the stage covers it.
function originX() {
  const width = record.cols * zoom();
  const wanted = canvas.clientWidth / 2 - state.col * zoom();
  return width <= canvas.clientWidth + 1 ? (canvas.clientWidth - width) / 2 : clamp(wanted, canvas.clientWidth - width, 0);
}

function originY() {
  const height = record.rows * zoom();
  const wanted = canvas.clientHeight / 2 - state.row * zoom();
  return height <= canvas.clientHeight + 1 ? (canvas.clientHeight - height) / 2 : clamp(wanted, canvas.clientHeight - height, 0);
}

// The boundary on the stage, CSS pixels: a share of what is seen of the picture.
function edge() {
  const left = Math.max(0, originX());
  const right = Math.min(canvas.clientWidth, originX() + record.cols * zoom());
  return left + state.cut * (right - left);
}

// A picture of panel pixels from a function of pixel and sample.
function picture(colourOf) {
  const small = new OffscreenCanvas(record.cols, record.rows);
  const image = new ImageData(record.cols, record.rows);
  const pixels = new Uint32Array(image.data.buffer);
  const first = state.slot * N_PIXELS;
  for (let i = 0; i < N_PIXELS; i++) pixels[i] = colourOf(i, first + i);
  small.getContext("2d").putImageData(image, 0, 0);
  return small;
}

function light(side, truth) {
  if (coloursOf !== state.stops) {
    coloursOf = state.stops;
    colours = exposed(record.white_cd_m2 * 2 ** -state.stops);
  }
  return picture((i, sample) => {
    const colour = colours[side.light[sample]];
    if (state.mark === "given up" && !(side.marks[i] & 1)) return chequer(i);
    if (state.mark === "open" && side.levels?.[sample]) return tinted(colour, GREEN);
    if (state.mark === "moving") {
      const [held, moves] = [side.marks[i] & 2, truth.marks[i] & 2];
      const kind = held && moves ? 0 : moves ? 1 : held ? 2 : -1;
      if (kind >= 0) return tinted(colour, LEGENDS.moving[kind][0]);
    }
    return colour;
  });
}

function differing(left, right, i, sample) {
  if (!(left.marks[i] & right.marks[i] & 1)) return chequer(i);
  return shade(STOPS_OF[left.light[sample]] - STOPS_OF[right.light[sample]], state.limit);
}

function chequer(i) {
  const odd = (Math.floor(i / record.cols) + i) & 1;
  return odd ? rgba(138, 138, 138) : rgba(112, 112, 112);
}

function tinted(colour, tint) {
  const mixed = (shift, part) => Math.round(0.45 * ((colour >>> shift) & 255) + 0.55 * part);
  return rgba(mixed(0, tint[0]), mixed(8, tint[1]), mixed(16, tint[2]));
}

// --- controls -------------------------------------------------------------------------------------------

const signed = (value, digits) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits);
const rounded = (value) => (value >= 1000 ? value.toFixed(0) : value.toPrecision(3));

function controls() {
  for (const id of ["left", "right", "frame", "mark", "limit"]) at(id).value = String(state[id]);
  for (const button of view.querySelectorAll("[data-view]")) {
    button.setAttribute("aria-pressed", String(button.dataset.view === state.view));
  }
  at("cut").value = String(100 * state.cut);
  at("cut").disabled = state.view !== "slider";
  at("slot").value = String(state.slot);
  at("slot-text").textContent = `${state.slot} of ${record.slots - 1}`;
  at("exposure").value = String(state.stops);
  at("exposure-text").textContent = `${signed(state.stops, 1)} stops`;
  at("chosen").textContent =
    `Coded frame ${state.frame}, slot ${state.slot}; ${rounded(record.white_cd_m2 * 2 ** -state.stops)} cd/m² is white.`;
  at("zoom-text").textContent = `${zoom().toFixed(1)} ×`;
  at("scale").hidden = state.view !== "difference";
  at("ticks").replaceChildren(
    ...[-1, -0.5, 0, 0.5, 1].map((share) => {
      const tick = document.createElement("span");
      tick.textContent = share ? signed(share * state.limit, Number.isInteger(share * state.limit) ? 0 : 2) : "0";
      return tick;
    }),
  );
  at("legend").replaceChildren(
    ...(state.view === "difference" ? [] : (LEGENDS[state.mark] ?? [])).map(([colour, meaning]) => {
      const item = document.createElement("li");
      const patch = document.createElement("i");
      patch.style.background = `rgb(${colour})`;
      item.append(patch, meaning);
      return item;
    }),
  );
  const rightAlone = state.view === "right" || (state.view === "blink" && blinkRight);
  at("tag-left").textContent =
    state.view === "difference" ? `${label(state.left)} − ${label(state.right)}` : label(rightAlone ? state.right : state.left);
  at("tag-right").textContent = state.view === "slider" ? label(state.right) : "";
  const line = view.querySelector(".edge");
  line.hidden = state.view !== "slider";
  line.style.left = `${edge()}px`;
  canvas.style.cursor = state.zoom ? "grab" : state.view === "slider" ? "ew-resize" : "crosshair";
  canvas.style.touchAction = state.zoom ? "none" : "pan-y";
}

for (const id of ["left", "right"]) {
  at(id).append(...NAMES.map((name) => new Option(label(name), name)));
}
at("exposure").min = String(START - 16);
at("exposure").max = String(START + 10);
at("exposure").step = "any";
for (const id of ["left", "right", "mark"]) at(id).addEventListener("change", (e) => set({ [id]: e.target.value }));
for (const id of ["frame", "limit"]) at(id).addEventListener("change", (e) => set({ [id]: Number(e.target.value) }));
at("cut").addEventListener("input", (e) => set({ cut: e.target.value / 100 }));
at("slot").addEventListener("input", (e) => set({ slot: Number(e.target.value) }));
at("exposure").addEventListener("input", (e) => set({ stops: Number(e.target.value) }));
for (const button of view.querySelectorAll("[data-view]")) {
  button.addEventListener("click", () => set({ view: button.dataset.view }));
}
for (const button of document.querySelectorAll("[data-show]")) {
  button.addEventListener("click", () => showState(JSON.parse(button.dataset.show)));
}

const actions = {
  swap: () => set({ left: state.right, right: state.left }),
  auto: () => set({ stops: autoExposure() }),
  fit: () => set({ zoom: 0, box: null }),
  in: () => zoomAt(1.5),
  out: () => zoomAt(1 / 1.5),
  play: togglePlay,
};
for (const [id, action] of Object.entries(actions)) at(id).addEventListener("click", action);

// The median of what is seen of the left picture becomes middle grey.
function autoExposure() {
  if (!shown) return START;
  const seen = [];
  const first = state.slot * N_PIXELS;
  const [top, low] = [-originY() / zoom(), (canvas.clientHeight - originY()) / zoom()];
  const [near, far] = [-originX() / zoom(), (canvas.clientWidth - originX()) / zoom()];
  for (let row = Math.max(0, Math.floor(top)); row < Math.min(record.rows, low); row++) {
    for (let col = Math.max(0, Math.floor(near)); col < Math.min(record.cols, far); col++) {
      seen.push(shown.left.light[first + row * record.cols + col]);
    }
  }
  const median = luminance(seen.sort((a, b) => a - b)[seen.length >> 1]);
  return Math.log2((0.18 * record.white_cd_m2) / Math.max(median, record.floor_cd_m2));
}

let playing = 0;
function togglePlay() {
  clearInterval(playing);
  playing = playing ? 0 : setInterval(() => set({ slot: (state.slot + 1) % record.slots }), 90);
  at("play").textContent = playing ? "Pause" : "Play";
  at("play").setAttribute("aria-pressed", String(Boolean(playing)));
}

setInterval(() => {
  if (state.view !== "blink") return;
  blinkRight = !blinkRight;
  draw();
}, 600);

function zoomAt(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
  const [col, row] = [(x - originX()) / zoom(), (y - originY()) / zoom()];
  const next = clamp(zoom() * factor, fitZoom(), 64);
  // The pixel under the pointer stays there.
  return set({
    zoom: next,
    col: col + (canvas.clientWidth / 2 - x) / next,
    row: row + (canvas.clientHeight / 2 - y) / next,
  });
}

const keys = {
  ArrowLeft: () => set({ slot: state.slot - 1 }),
  ArrowRight: () => set({ slot: state.slot + 1 }),
  ArrowUp: () => set({ stops: state.stops + 0.5 }),
  ArrowDown: () => set({ stops: state.stops - 0.5 }),
  a: actions.auto,
  x: actions.swap,
  f: actions.fit,
  p: actions.play,
  "+": actions.in,
  "=": actions.in,
  "-": actions.out,
  s: () => set({ view: "slider" }),
  b: () => set({ view: "blink" }),
  l: () => set({ view: "left" }),
  r: () => set({ view: "right" }),
  d: () => set({ view: "difference" }),
  m: () => set({ mark: MARKS[(MARKS.indexOf(state.mark) + 1) % MARKS.length] }),
  n: () => {
    const indices = record.frames.map((frame) => frame.index);
    return set({ frame: indices[(indices.indexOf(state.frame) + 1) % indices.length] });
  },
};
view.addEventListener("keydown", (event) => {
  const own = event.target.matches("input, select") && event.key.startsWith("Arrow");
  if (own || event.target.matches("select") || event.ctrlKey || event.metaKey || event.altKey) return;
  const number = /^[0-9]$/.test(event.key) ? Number(event.key) : -1;
  const action = number >= 0 && number < NAMES.length ? () => set({ left: NAMES[number] }) : keys[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

// --- pointer --------------------------------------------------------------------------------------------

const pointers = new Map();
const place = (event) => [event.offsetX, event.offsetY];
const spread = () => {
  const [a, b] = [...pointers.values()];
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
};
let grip = ""; // what a drag moves: the boundary or the picture

function moveEdge(x) {
  const left = Math.max(0, originX());
  const right = Math.min(canvas.clientWidth, originX() + record.cols * zoom());
  set({ cut: (x - left) / (right - left) });
}

canvas.addEventListener("pointerdown", (event) => {
  view.focus({ preventScroll: true });
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, place(event));
  const near = state.view === "slider" && (!state.zoom || Math.abs(event.offsetX - edge()) < 20);
  grip = near ? "edge" : state.zoom ? "picture" : "";
  if (grip === "edge") moveEdge(event.offsetX);
  readOut(...place(event));
});
canvas.addEventListener("pointermove", (event) => {
  readOut(...place(event));
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const old = pointers.size === 2 ? spread() : 0;
  pointers.set(event.pointerId, place(event));
  if (old) zoomAt(spread() / old, ...place(event));
  else if (grip === "edge") moveEdge(event.offsetX);
  else if (grip === "picture") {
    set({ col: state.col - (event.offsetX - before[0]) / zoom(), row: state.row - (event.offsetY - before[1]) / zoom() });
  }
});
for (const kind of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
}
canvas.addEventListener(
  "wheel",
  (event) => {
    if (!event.ctrlKey && !view.contains(document.activeElement)) return;
    event.preventDefault();
    zoomAt(2 ** (-event.deltaY / 300), ...place(event));
  },
  { passive: false },
);

function readOut(x, y) {
  const [row, col] = [Math.floor((y - originY()) / zoom()), Math.floor((x - originX()) / zoom())];
  if (!shown || row < 0 || col < 0 || row >= record.rows || col >= record.cols) return;
  const i = row * record.cols + col;
  const [left, right] = [shown.left, shown.right].map((side) => luminance(side.light[state.slot * N_PIXELS + i]));
  const given = [[state.left, shown.left], [state.right, shown.right]].filter(([, side]) => !(side.marks[i] & 1));
  at("readout").textContent =
    `row ${row}, column ${col}: ${label(state.left)} ${rounded(left)}, ${label(state.right)} ${rounded(right)} cd/m², ` +
    `${signed(stops(left, right), 2)} stops` + given.map(([name]) => `; given up by ${label(name)}`).join("");
}

new ResizeObserver(() => set({})).observe(canvas);
