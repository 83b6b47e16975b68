// The skeleton in three dimensions, and how it is turned.

const VIEWS = { front: [0, 0], side: [Math.PI / 2, 0], top: [0, Math.PI / 2], start: [0.55, 0.22] };
const view = { yaw: VIEWS.start[0], pitch: VIEWS.start[1], zoom: 1 };
const DISTANCE = 3.6; // of the eye from the middle, in radii
let scene = null;

/** Middle and size of what the persons do (half of its height apart), and the floor, metres. */
function measureScene() {
  const all = people.filter((p) => Number.isFinite(quantile(coordinate(p.joints, 0), 0.5)));
  if (!all.length) return { middle: [0, 0, 2], radius: 0.9, half: 0.9, floor: 0.6 };
  const box = [0, 1, 2].map((axis) => {
    const ends = all.flatMap((p) => [p.joints, p.truth || p.joints]).map((joints) => {
      const values = coordinate(joints, axis);
      return [quantile(values, 0.002), quantile(values, 0.998)];
    });
    return [Math.min(...ends.map((e) => e[0])), Math.max(...ends.map((e) => e[1]))];
  });
  const middle = box.map(([low, high]) => (low + high) / 2);
  if (all.length === 1) {
    for (const axis of [0, 2]) middle[axis] = quantile(coordinate(all[0].joints, axis, NECK), 0.5);
  }
  const floor = Math.ceil((box[1][1] + 0.05) * 10) / 10;
  middle[1] = (box[1][0] - 0.1 + floor) / 2;
  const halves = box.map(([low, high], i) => Math.max(high - middle[i], middle[i] - low));
  const radius = Math.min(6, Math.max(0.55, ...halves) + 0.12);
  return { middle, floor, radius, half: Math.max(halves[1] + 0.12, 0.7 * radius) };
}

function makeCamera(width, height) {
  const [cy, sy] = [Math.cos(view.yaw), Math.sin(view.yaw)];
  const [cp, sp] = [Math.cos(view.pitch), Math.sin(view.pitch)];
  const rows = [[cy, 0, sy], [sp * sy, cp, -sp * cy], [-cp * sy, sp, cp * cy]];
  const size = 0.45 * Math.min(width / scene.radius, height / scene.half) * view.zoom;
  const eye = DISTANCE * scene.radius;
  const turn = (v) => rows.map((r) => r[0] * v[0] + r[1] * v[1] + r[2] * v[2]);
  const project = (point) => {
    const [x, y, z] = turn(point.map((value, i) => value - scene.middle[i]));
    const near = eye / Math.max(0.15 * eye, eye + z);
    return { x: width / 2 + size * near * x, y: height / 2 + size * near * y, z, near };
  };
  return { rows, size, turn, project };
}

function line(ctx, a, b) {
  ctx.beginPath();
  ctx.moveTo(a.x, a.y);
  ctx.lineTo(b.x, b.y);
  ctx.stroke();
}

function drawFloor(ctx, camera) {
  const step = scene.radius > 1.6 ? 0.5 : 0.2;
  const reach = Math.ceil(scene.radius * 0.95 / step) * step;
  const [x0, z0] = [0, 2].map((axis) => Math.round(scene.middle[axis] / step) * step);
  ctx.strokeStyle = look.grid;
  ctx.lineWidth = 1;
  for (let d = -reach; d < reach + step / 2; d += step) {
    line(ctx, camera.project([x0 + d, scene.floor, z0 - reach]),
      camera.project([x0 + d, scene.floor, z0 + reach]));
    line(ctx, camera.project([x0 - reach, scene.floor, z0 + d]),
      camera.project([x0 + reach, scene.floor, z0 + d]));
  }
  const front = camera.project([x0, scene.floor, z0 - reach - 0.04]);
  ctx.fillStyle = look.muted;
  ctx.font = `12px ${FONT}`;
  ctx.textAlign = "center";
  if (data.frame === "camera" && view.pitch > 0.08) ctx.fillText("towards the camera", front.x, front.y + 12);
  return step;
}

function drawAxes(ctx, camera, width, height, step) {
  const origin = { x: 42, y: height - 46 };
  ctx.font = `12px ${FONT}`;
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  ["x", "y", "z"].forEach((name, axis) => {
    const unit = [0, 0, 0];
    unit[axis] = 1;
    const [x, y] = camera.turn(unit);
    ctx.strokeStyle = look.muted;
    ctx.lineWidth = 1.5;
    line(ctx, origin, { x: origin.x + 24 * x, y: origin.y + 24 * y });
    ctx.fillStyle = look.muted;
    if (Math.hypot(x, y) > 0.2) ctx.fillText(name, origin.x + 33 * x, origin.y + 33 * y);
  });
  ctx.textAlign = "right";
  ctx.textBaseline = "alphabetic";
  ctx.fillText(`squares of ${100 * step} cm`, width - 12, height - 10);
}

const corner = (joints, j) => [joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]];
const finite = (point) => point.every(Number.isFinite);

function drawShadow(ctx, camera, joints) {
  ctx.strokeStyle = look.shadow;
  ctx.lineWidth = 4;
  ctx.lineCap = "round";
  for (const [a, b] of data.limbs) {
    const ends = [a, b].map((j) => corner(joints, j));
    if (!ends.every(finite)) continue;
    line(ctx, ...ends.map(([x, , z]) => camera.project([x, scene.floor, z])));
  }
}

function drawStick(ctx, camera, joints) {
  ctx.strokeStyle = look.truth;
  ctx.lineCap = "round";
  ctx.lineWidth = 3;
  for (const [a, b] of data.limbs) {
    const ends = [a, b].map((j) => corner(joints, j));
    if (ends.every(finite)) line(ctx, ...ends.map(camera.project));
  }
}

/** The outline of an ellipsoid: that of its covariance after the projection near the joint. */
function drawEllipsoid(ctx, camera, point, c, color) {
  const p = camera.project(point);
  const C = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
  const scale = camera.size * p.near * RADIUS_3D;
  const [u, v] = [camera.rows[0], camera.rows[1]];
  const form = (a, b) => {
    let sum = 0;
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) sum += a[i] * C[i][j] * b[j];
    return sum;
  };
  const [xx, xy, yy] = [form(u, u), form(u, v), form(v, v)];
  const middle = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  const long = scale * Math.sqrt(Math.max(0, middle + spread));
  const short = scale * Math.sqrt(Math.max(0, middle - spread));
  if (!Number.isFinite(long + short) || long > 1e4) return;
  ctx.beginPath();
  ctx.ellipse(p.x, p.y, long, short, Math.atan2(2 * xy, xx - yy) / 2, 0, 2 * Math.PI);
  ctx.fillStyle = ctx.strokeStyle = color;
  const alpha = ctx.globalAlpha;
  ctx.globalAlpha = 0.1 * alpha;
  ctx.fill();
  ctx.globalAlpha = 0.75 * alpha;
  ctx.lineWidth = 1;
  ctx.stroke();
  ctx.globalAlpha = alpha;
}

function drawPerson(ctx, camera, person, joints, frame) {
  const parts = [];
  const points = data.names.map((_, j) => camera.project(corner(joints, j)));
  for (const [a, b] of data.limbs) {
    if (![a, b].every((j) => finite(corner(joints, j)))) continue;
    const color = data.sides[a] === data.sides[b] ? jointColor(a) : look.middle;
    parts.push({ z: (points[a].z + points[b].z) / 2 + 0.01, draw: () => {
      ctx.lineCap = "round";
      const width = 6 * Math.sqrt(view.zoom) * (points[a].near + points[b].near) / 2;
      for (const [paint, w] of [[look.panel, width + 3], [color, width]]) {
        ctx.strokeStyle = paint;
        ctx.lineWidth = w;
        line(ctx, points[a], points[b]);
      }
    } });
  }
  data.names.forEach((_, j) => {
    if (!finite(corner(joints, j))) return;
    const measured = isMeasured(person, frame - person.first, j);
    const size = 6.5 * Math.sqrt(view.zoom) * points[j].near;
    parts.push({ z: points[j].z - 0.1, draw: () => {
      ctx.beginPath();
      ctx.arc(points[j].x, points[j].y, size, 0, 2 * Math.PI);
      ctx.fillStyle = measured ? jointColor(j) : look.panel;
      ctx.strokeStyle = measured ? look.panel : jointColor(j);
      ctx.lineWidth = measured ? 1.5 : 3;
      ctx.fill();
      ctx.stroke();
    } });
  });
  parts.sort((a, b) => b.z - a.z).forEach((part) => part.draw());
}

function drawBody() {
  const { ctx, width, height } = prepare($("body"));
  if (!width || !height) return;
  scene = scene || measureScene();
  const camera = makeCamera(width, height);
  const step = drawFloor(ctx, camera);
  drawAxes(ctx, camera, width, height, step);
  const drawn = people.map((p, i) => ({ p, i, joints: jointsAt(p, state.frame) }))
    .filter((d) => d.joints);
  drawn.forEach((d) => drawShadow(ctx, camera, d.joints));
  drawn.sort((a, b) => (a.i === state.person) - (b.i === state.person));
  for (const { p, i, joints } of drawn) {
    ctx.globalAlpha = i === state.person ? 1 : 0.45;
    const truth = $("show-truth").checked && truthAt(p, state.frame);
    if (truth) drawStick(ctx, camera, truth);
    const covariance = $("show-ellipsoids").checked && covarianceAt(p, state.frame);
    if (covariance) {
      data.names.forEach((_, j) => {
        const point = corner(joints, j);
        if (hasEllipsoid(p, state.frame - p.first, j) && finite(point)) {
          drawEllipsoid(ctx, camera, point, covariance.subarray(6 * j, 6 * j + 6), jointColor(j));
        }
      });
    }
    drawPerson(ctx, camera, p, joints, state.frame);
    const head = camera.project(corner(joints, data.names.indexOf("head")));
    if (people.length > 1 && Number.isFinite(head.x)) {
      ctx.fillStyle = look.ink;
      ctx.font = `13px ${FONT}`;
      ctx.textAlign = "center";
      ctx.fillText(p.label, head.x, head.y - 18);
    }
    ctx.globalAlpha = 1;
  }
  if (!drawn.length) {
    ctx.fillStyle = look.muted;
    ctx.font = `14px ${FONT}`;
    ctx.textAlign = "center";
    const words = people.length ? "no pose in this frame" : "nobody was tracked";
    ctx.fillText(words, width / 2, height / 2);
  }
}

// --- turning it

function setView(name) {
  [view.yaw, view.pitch] = VIEWS[name];
  if (name === "start") view.zoom = 1;
  redrawBody(name);
}

function redrawBody(name = null) {
  document.querySelectorAll(".views button").forEach((b) =>
    b.setAttribute("aria-pressed", String(b.dataset.view === name && name !== "start")));
  requestAnimationFrame(drawBody);
}

function turnBy(yaw, pitch) {
  view.yaw += yaw;
  view.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, view.pitch + pitch));
  redrawBody();
}

function zoomBy(factor) {
  view.zoom = Math.min(6, Math.max(0.35, view.zoom * factor));
  redrawBody();
}

function setUpBody() {
  const canvas = $("body");
  const pointers = new Map();
  const apart = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = pointers.size === 2 ? apart() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before > 0) zoomBy(apart() / before);
    else turnBy(-0.009 * (event.clientX - last.x), 0.009 * (event.clientY - last.y));
  });
  for (const type of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(type, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const unit = event.deltaMode === 1 ? 16 : 1; // lines or pixels
    zoomBy(Math.exp(-0.0015 * unit * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => setView("start"));
  const keys = { ArrowLeft: () => turnBy(0.1, 0), ArrowRight: () => turnBy(-0.1, 0),
    ArrowUp: () => turnBy(0, -0.1), ArrowDown: () => turnBy(0, 0.1), "+": () => zoomBy(1.15),
    "=": () => zoomBy(1.15), "-": () => zoomBy(1 / 1.15), 1: () => setView("front"),
    2: () => setView("side"), 3: () => setView("top"), 0: () => setView("start") };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    keys[event.key]();
  });
  document.querySelectorAll(".views button").forEach((button) =>
    button.addEventListener("click", () => setView(button.dataset.view)));
  $("show-ellipsoids").addEventListener("change", drawBody);
  $("show-truth").addEventListener("change", () => { drawBody(); drawCurves(); });
}
