// Light of the viewer: files of codes below the run folder, and their decoding (optsim/report/light_code.py).
const record = JSON.parse(document.getElementById("viewer-record").textContent);
const N_PIXELS = record.rows * record.cols;

// A page opened from disk may not read image files, but it may run scripts beside it; each calls this.
const arriving = new Map();
globalThis.optsimLight = (file, text) => arriving.get(file)?.(text);

const videos = new Map();

// Promise of { light, marks, levels } of a method, or of the truth, "", in a coded frame.
function video(frame, name) {
  const shown = record.frames.find((each) => each.index === frame);
  const file = name === "" ? shown.truth : shown.methods[name];
  if (!videos.has(file)) videos.set(file, load(file).then(inflate).then((bytes) => unpack(bytes, name !== "")));
  return videos.get(file);
}

function load(file) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    arriving.set(file, resolve);
    script.onload = () => reject(new Error(`${file} holds no light`));
    script.onerror = () => reject(new Error(`${file} is missing: move the page together with its assets folder`));
    script.src = file.split("/").map(encodeURIComponent).join("/");
    document.head.append(script);
  });
}

async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function unpack(bytes, hasLevels) {
  const n = record.slots * N_PIXELS;
  const light = new Uint16Array(n);
  for (let i = 0; i < n; i++) {
    const packed = bytes[i] | (bytes[n + i] << 8);
    const step = packed & 1 ? -(packed + 1) / 2 : packed / 2;
    light[i] = i < N_PIXELS ? step : light[i - N_PIXELS] + step;
  }
  const marks = bytes.subarray(2 * n, 2 * n + N_PIXELS);
  if (!hasLevels) return { light, marks, levels: null };
  const levels = bytes.slice(2 * n + N_PIXELS);
  for (let i = N_PIXELS; i < n; i++) levels[i] ^= levels[i - N_PIXELS];
  return { light, marks, levels };
}

// Luminance of a code, cd/m².
function luminance(code) {
  return record.floor_cd_m2 * (2 ** (code / record.steps_per_stop) - 1);
}

// Error of one luminance against another, in stops, as the scores have it.
function stops(ours, theirs) {
  return Math.log2((ours + record.e_cd_m2) / (theirs + record.e_cd_m2));
}

const N_CODES = 65536;
const STOPS_OF = Float32Array.from({ length: N_CODES }, (_, code) => Math.log2(luminance(code) + record.e_cd_m2));

// Display colours of all codes, little-endian RGBA: sRGB with so much luminance as white.
function exposed(white) {
  const colours = new Uint32Array(N_CODES).fill(0xffffffff);
  for (let code = 0; code < N_CODES; code++) {
    const share = luminance(code) / white;
    if (share >= 1) break;
    const grey = Math.round(255 * (share <= 0.0031308 ? 12.92 * share : 1.055 * share ** (1 / 2.4) - 0.055));
    colours[code] = rgba(grey, grey, grey);
  }
  return colours;
}

function rgba(red, green, blue) {
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}

// Colours of a signed error, from too dark to too bright.
const ANCHORS = ["#08306b", "#2f74c0", "#a9cbe8", "#f4f3ef", "#f2b08c", "#cc4c2d", "#6e1414"];
const N_SHADES = 601;
const SHADES = Uint32Array.from({ length: N_SHADES }, (_, i) => {
  const place = (i / (N_SHADES - 1)) * (ANCHORS.length - 1);
  const first = Math.min(Math.floor(place), ANCHORS.length - 2);
  const mixed = [1, 3, 5].map((at) => {
    const [low, high] = [first, first + 1].map((k) => parseInt(ANCHORS[k].slice(at, at + 2), 16));
    return Math.round(low + (high - low) * (place - first));
  });
  return rgba(...mixed);
});

function shade(error, limit) {
  const place = Math.round((error / (2 * limit) + 0.5) * (N_SHADES - 1));
  return SHADES[Math.max(0, Math.min(N_SHADES - 1, place))];
}
