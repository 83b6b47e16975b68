// What the page holds: numbers of each person, and the colours and canvases to draw them with.
"use strict";

const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const RADIUS_2D = 1.6449; // 90 % of a Gaussian in one dimension
const RADIUS_3D = 2.5003; // and in three
const ARRAYS = { float32: Float32Array, uint8: Uint8Array };
const JOINTS = data.names.length;
const OBSERVED_BYTES = Math.ceil(JOINTS / 8); // of a frame, one bit per joint
const NECK = data.names.indexOf("neck");
const AXES = data.frame === "camera"
  ? ["x, right", "y, down", "z, away"] : ["x, left", "y, down", "z, back"];

const fps = data.fps;
const total = Math.max(1, data.frames);
const state = { frame: 0, playing: false, person: 0, joint: 0, speed: 1 };
const people = data.people.map(unpackPerson);
let look = readColors();

// --- numbers of a person

function unpack(packed) {
  if (!packed) return null;
  const text = atob(packed.base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[packed.type](bytes.buffer); // little-endian, as all that browsers run on
}

function unpackPerson(p) {
  const person = { ...p, joints: unpack(p.joints), covariance: unpack(p.covariance),
    observed: unpack(p.observed), there: unpack(p.there), truth: unpack(p.truth),
    curves: unpack(p.curves), kept: p.joints.shape[0] };
  person.buckets = p.curves ? p.curves.shape[3] : 0;
  return person;
}

const isThere = (p, i) => !p.there || p.there[i] === 1;
const isMeasured = (p, i, joint) =>
  ((p.observed[i * OBSERVED_BYTES + (joint >> 3)] >> (joint & 7)) & 1) === 1;

/** Whether an ellipsoid is drawn: of inferred joints, and of all where all are measured alike, as by outlines. */
const hasEllipsoid = (p, i, joint) =>
  p.measured.every((share) => share === p.measured[0]) || !isMeasured(p, i, joint);

/** Numbers of a person at a frame of the video, evenly between kept poses; null where none is. */
function at(p, values, width, frame) {
  const i = frame - p.first;
  if (!values || i < 0 || i >= p.frames || !isThere(p, i)) return null;
  const k = Math.min(Math.floor(i / p.stride), p.kept - 1);
  const a = k + 1 < p.kept ? i / p.stride - k : 0;
  const out = values.slice(k * width, (k + 1) * width);
  if (a > 0) {
    for (let j = 0; j < width; j++) out[j] += a * (values[(k + 1) * width + j] - out[j]);
  }
  return out.some(Number.isFinite) ? out : null;
}

const jointsAt = (p, frame) => at(p, p.joints, 3 * JOINTS, frame);
const covarianceAt = (p, frame) => at(p, p.covariance, 6 * JOINTS, frame);
const truthAt = (p, frame) => at(p, p.truth, 3 * JOINTS, frame);

function quantile(values, q) {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  return sorted.length ? sorted[Math.round(q * (sorted.length - 1))] : NaN;
}

function coordinate(values, axis, joint = null) {
  const picked = [];
  for (let i = axis; i < values.length; i += 3) {
    if (joint === null || Math.floor(i / 3) % JOINTS === joint) picked.push(values[i]);
  }
  return picked;
}

// --- colours and canvases

function readColors() {
  const style = getComputedStyle(document.documentElement);
  const names = ["page", "panel", "ink", "muted", "line", "grid", "gap", "truth", "shadow",
    "left", "right", "middle"];
  return Object.fromEntries(names.map((n) => [n, style.getPropertyValue("--" + n).trim()]));
}

const jointColor = (joint) => look[data.sides[joint]];

/** The context of a canvas, in CSS pixels and as sharp as the screen. */
function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.max(1, Math.round(width * ratio));
  canvas.height = Math.max(1, Math.round(height * ratio));
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return { ctx, width, height };
}

const FONT = "system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
