// Strips of what was measured, and the curves of the chosen joint.

function margins() {
  const style = getComputedStyle(document.documentElement);
  return { left: parseFloat(style.getPropertyValue("--label-width")),
    right: parseFloat(style.getPropertyValue("--share-width")) };
}

function drawStrip(canvas, person, joint) {
  const { ctx, width, height } = prepare(canvas);
  ctx.fillStyle = look.grid;
  ctx.fillRect(0, height - 1, width, 1);
  ctx.fillStyle = jointColor(joint);
  const columns = Math.ceil(width);
  for (let column = 0; column < columns; column++) {
    const from = Math.floor(column / width * total) - person.first;
    const to = Math.max(from + 1, Math.floor((column + 1) / width * total) - person.first);
    let there = 0, measured = 0;
    for (let i = Math.max(0, from); i < Math.min(to, person.frames); i++) {
      if (!isThere(person, i)) continue;
      there++;
      measured += isMeasured(person, i, joint);
    }
    if (!there) continue;
    const tall = 2 + (height - 3) * measured / there;
    ctx.fillRect(column, height - 1 - tall, 1.05, tall);
  }
}

/** Points of a curve: [frame, lowest, highest, lower end of the band, upper end], centimetres. */
function curve(p, joint, axis) {
  const points = [];
  if (p.curves) {
    const stride = JOINTS * 3 * p.buckets, row = (3 * joint + axis) * p.buckets;
    for (let b = 0; b < p.buckets; b++) {
      const frame = p.first + Math.min((b + 0.5) * p.bucket, p.frames - 1);
      points.push([frame, ...[0, 1, 2, 3].map((k) => 100 * p.curves[k * stride + row + b])]);
    }
    return points;
  }
  const diagonal = [0, 3, 5][axis];
  for (let k = 0; k < p.kept; k++) {
    const value = 100 * p.joints[(k * JOINTS + joint) * 3 + axis];
    const variance = p.covariance[(k * JOINTS + joint) * 6 + diagonal];
    const half = 100 * RADIUS_2D * Math.sqrt(Math.max(0, variance));
    const there = isThere(p, k * p.stride) ? value : NaN;
    points.push([p.first + k * p.stride, there, there, there - half, there + half]);
  }
  return points;
}

function truthCurve(p, joint, axis) {
  if (!p.truth || !$("show-truth").checked) return [];
  return Array.from({ length: p.kept }, (_, k) => {
    const value = 100 * p.truth[(k * JOINTS + joint) * 3 + axis];
    return [p.first + k * p.stride, value, value];
  });
}

function valueRange(points) {
  const band = points.flatMap((c) => [c[3], c[4]]);
  const values = points.flatMap((c) => [c[1], c[2]]).filter(Number.isFinite);
  if (!values.length) return [-50, 50];
  let low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
  const ends = [quantile(band, 0.02), quantile(band, 0.98)];
  if (Number.isFinite(ends[0])) low = Math.min(low, ends[0]);
  if (Number.isFinite(ends[1])) high = Math.max(high, ends[1]);
  const spare = Math.max(0.06 * (high - low), (12 - (high - low)) / 2);
  return [low - spare, high + spare];
}

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= rough);
  const found = [];
  for (let i = Math.ceil(low / step); i <= high / step + 1e-9; i++) found.push(i * step);
  return found;
}

/** Shades the frames in which the joint was inferred, unless it always was. */
function drawGaps(ctx, p, joint, toX, top, height) {
  if (p.measured[joint] === 0) return;
  ctx.fillStyle = look.gap;
  let start = -1;
  for (let i = 0; i <= p.frames; i++) {
    const gap = i < p.frames && isThere(p, i) && !isMeasured(p, i, joint);
    if (gap && start < 0) start = i;
    if (!gap && start >= 0) {
      const x = toX(p.first + start - 0.5);
      ctx.fillRect(x, top, Math.max(1, toX(p.first + i - 0.5) - x), height);
      start = -1;
    }
  }
}

/** Calls draw for each stretch of points that are numbers. */
function stretches(points, draw) {
  let run = [];
  for (const point of [...points, [NaN, NaN]]) {
    if (Number.isFinite(point[1])) run.push(point);
    else if (run.length) { draw(run); run = []; }
  }
}

function drawCurves() {
  const { ctx, width, height } = prepare($("curves"));
  const p = people[state.person];
  if (!p || !width) return;
  const { left, right } = margins();
  const inner = Math.max(1, width - left - right);
  const bottom = 22, gap = 16;
  const tall = (height - bottom - 2 * gap - 4) / 3;
  const toX = (frame) => left + (frame + 0.5) / total * inner;
  const color = jointColor(state.joint);
  ctx.font = `12px ${FONT}`;
  AXES.forEach((name, axis) => {
    const top = 4 + axis * (tall + gap);
    const points = curve(p, state.joint, axis), truth = truthCurve(p, state.joint, axis);
    const [low, high] = valueRange([...points, ...truth.map((t) => [...t, NaN, NaN])]);
    // y grows downwards, so its curve goes up when the joint does
    const share = (v) => axis === 1 ? (v - low) / (high - low) : (high - v) / (high - low);
    const toY = (v) => top + tall * share(v);
    drawGaps(ctx, p, state.joint, toX, top, tall);
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    for (const value of ticks(low, high, 4)) {
      const y = toY(value);
      ctx.fillStyle = look.grid;
      ctx.fillRect(left, Math.round(y), inner, 1);
      ctx.fillStyle = look.muted;
      ctx.fillText(String(+value.toFixed(6)).replace("-", "\u2212"), left - 7, y);
    }
    ctx.textAlign = "left";
    ctx.fillStyle = look.ink;
    ctx.fillText(name, 2, top + 7);
    ctx.fillStyle = look.muted;
    ctx.fillText("cm", 2, top + 22);
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top - 1, inner, tall + 2);
    ctx.clip();
    stretches(points.filter((c) => c.length), (run) => drawBand(ctx, run, toX, toY, color));
    stretches(truth, (run) => drawRun(ctx, run, toX, toY, look.truth));
    stretches(points, (run) => drawRun(ctx, run, toX, toY, color));
    ctx.restore();
    ctx.strokeStyle = look.line;
    ctx.lineWidth = 1;
    ctx.strokeRect(left + 0.5, top + 0.5, inner - 1, tall - 1);
  });
  drawTimes(ctx, left, inner, height);
}

function drawTimes(ctx, left, inner, height) {
  const seconds = total / fps;
  ctx.fillStyle = look.muted;
  ctx.textAlign = "center";
  ctx.textBaseline = "alphabetic";
  const long = seconds >= 120;
  const unit = seconds >= 7200 ? 3600 : long ? 60 : 1;
  const count = Math.max(2, Math.min(10, Math.floor(inner / 90)));
  for (const value of ticks(0, seconds / unit, count)) {
    const x = left + value * unit / seconds * inner;
    const name = unit === 3600 ? "h" : unit === 60 ? "min" : "s";
    ctx.fillText(`${+value.toFixed(4)} ${name}`, x, height - 5);
  }
}

function drawBand(ctx, run, toX, toY, color) {
  const band = run.filter((c) => Number.isFinite(c[3] + c[4]));
  if (!band.length) return;
  ctx.fillStyle = color;
  ctx.globalAlpha = 0.2;
  ctx.beginPath();
  const edge = Math.max(0.5, toX(0.5) - toX(0)); // one frame alone has a width too
  const wide = band.length > 1 ? band : [[band[0][0] - edge, ...band[0].slice(1)], band[0],
    [band[0][0] + edge, ...band[0].slice(1)]];
  wide.forEach((c, i) => ctx[i ? "lineTo" : "moveTo"](toX(c[0]), toY(c[4])));
  [...wide].reverse().forEach((c) => ctx.lineTo(toX(c[0]), toY(c[3])));
  ctx.fill();
  ctx.globalAlpha = 1;
}

function drawRun(ctx, run, toX, toY, color) {
  ctx.strokeStyle = ctx.fillStyle = color;
  ctx.lineWidth = 1.6;
  ctx.lineJoin = "round";
  ctx.beginPath();
  for (const [i, c] of run.entries()) {
    ctx[i ? "lineTo" : "moveTo"](toX(c[0]), toY(c[1]));
    if (c[2] !== c[1]) ctx.lineTo(toX(c[0]), toY(c[2]));
  }
  ctx.stroke();
  if (run.length === 1) {
    ctx.beginPath();
    ctx.arc(toX(run[0][0]), toY(run[0][1]), 3, 0, 2 * Math.PI);
    ctx.fill();
  }
}

function buildStrips() {
  data.names.forEach((name, joint) => {
    const row = document.createElement("div");
    row.className = "strip";
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("role", "radio");
    button.textContent = name;
    button.addEventListener("click", () => choose(joint));
    const canvas = document.createElement("canvas");
    canvas.setAttribute("aria-hidden", "true");
    seekable(canvas, () => ({ left: 0, right: 0 }));
    const share = document.createElement("output");
    row.append(button, canvas, share);
    $("strips").append(row);
  });
}

/** With a proper minus sign; a question mark for what is not finite. */
const decimals = (value, digits) =>
  Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "?";

/** 100 % only for all frames, 0 % only for none. */
function percent(share) {
  if (share > 0 && share < 0.01) return "< 1 %";
  if (share > 0.99 && share < 1) return "> 99 %";
  return `${Math.round(100 * share)} %`;
}

function drawStrips() {
  const p = people[state.person];
  if (!p) return;
  [...$("strips").children].forEach((row, joint) => {
    const [button, canvas, share] = row.children;
    button.setAttribute("aria-checked", String(joint === state.joint));
    button.tabIndex = joint === state.joint ? 0 : -1;
    share.textContent = percent(p.measured[joint]);
    share.title = `measured in ${percent(p.measured[joint])} of the frames with a pose`;
    drawStrip(canvas, p, joint);
  });
}

function choose(joint) {
  state.joint = (joint + JOINTS) % JOINTS;
  drawStrips();
  drawCurves();
  writeValues();
}
