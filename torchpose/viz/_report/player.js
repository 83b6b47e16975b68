// Time: the video, or a clock of its own; what the user can press; and the start of it all.

const video = $("video");
let hasVideo = false;
let pending = false;

function clockText(frame) {
  const time = frame / fps;
  const minutes = Math.floor(time / 60);
  const seconds = (time - 60 * minutes).toFixed(2).padStart(5, "0");
  return `${minutes}:${seconds} · frame ${frame} of ${data.frames ? total - 1 : 0}`;
}

function writeValues() {
  const p = people[state.person];
  if (!p) return;
  const joint = state.joint;
  const name = data.names[joint];
  const who = people.length > 1 ? `, ${p.label}` : "";
  $("curve-title").textContent = name[0].toUpperCase() + name.slice(1) + who;
  const joints = jointsAt(p, state.frame), covariance = covarianceAt(p, state.frame);
  if (!joints) {
    $("curve-values").textContent = "No pose in this frame.";
    return;
  }
  const numbers = ["x", "y", "z"].map((axis, i) => {
    const variance = covariance ? covariance[6 * joint + [0, 3, 5][i]] : NaN; // null: none is finite
    const half = 100 * RADIUS_2D * Math.sqrt(Math.max(0, variance));
    return `${axis} ${decimals(100 * joints[3 * joint + i], 1)} ± ${decimals(half, 1)}`;
  });
  const measured = isMeasured(p, state.frame - p.first, joint);
  const word = measured ? "measured" : p.measured[joint] === 0 ? "inferred, never measured" : "inferred";
  $("curve-values").textContent = `${numbers.join(",  ")} cm (90 % band) · ${word} in this frame`;
}

function show(frame) {
  state.frame = Math.min(Math.max(0, Math.round(frame)), total - 1);
  if (pending) return;
  pending = true;
  requestAnimationFrame(() => {
    pending = false;
    $("slider").value = state.frame;
    $("slider").setAttribute("aria-valuetext", clockText(state.frame));
    $("clock").textContent = clockText(state.frame);
    moveCursor();
    drawBody();
    writeValues();
  });
}

function moveCursor() {
  const { left, right } = margins();
  const inner = $("plots").clientWidth - left - right;
  const x = left + (state.frame + 0.5) / total * inner;
  $("cursor").style.transform = `translateX(${x.toFixed(1)}px)`;
}

function seek(frame) {
  const target = Math.min(Math.max(0, Math.round(frame)), total - 1);
  // the middle of a frame, so that rounding of its time cannot show another one
  if (hasVideo) video.currentTime = (target + 0.5) / fps;
  clock.frame = target;
  clock.start = performance.now();
  show(target);
}

const clock = { frame: 0, start: 0 };

function tick(now) {
  if (!state.playing || hasVideo) return;
  const frame = clock.frame + (now - clock.start) / 1000 * fps * state.speed;
  show(frame);
  if (frame >= total - 1) setPlaying(false);
  else requestAnimationFrame(tick);
}

function setPlaying(on) {
  if (on && state.frame >= total - 1) seek(0);
  state.playing = on && total > 1;
  $("play").classList.toggle("on", state.playing);
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (hasVideo) {
    if (state.playing) {
      video.play().catch(() => setPlaying(false));
    } else if (!video.paused) {
      video.pause();
      show(Math.floor(video.currentTime * fps + 0.01));
    }
  } else if (state.playing) {
    clock.frame = state.frame;
    clock.start = performance.now();
    requestAnimationFrame(tick);
  }
}

function followVideo() {
  if (video.requestVideoFrameCallback) {
    const next = (_, info) => {
      if (state.playing) show(info.mediaTime * fps);
      video.requestVideoFrameCallback(next);
    };
    video.requestVideoFrameCallback(next);
  } else {
    const next = () => {
      if (state.playing) show(Math.floor(video.currentTime * fps + 0.01));
      requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }
  video.addEventListener("ended", () => { setPlaying(false); show(total - 1); });
  video.addEventListener("pause", () => { if (state.playing && !video.ended) setPlaying(false); });
}

function setUpVideo() {
  if (!data.video) {
    $("stage").classList.add("single");
    return;
  }
  $("video-panel").hidden = false;
  video.addEventListener("error", () => {
    hasVideo = false;
    video.hidden = true;
    $("stage").classList.add("single");
    $("video-message").hidden = false;
    $("video-message").textContent = data.video === "embedded"
      ? "This browser cannot play the overlay video; the skeleton plays without it."
      : `The overlay video is not where it should be (${decodeURIComponent(data.video)}); ` +
        "the skeleton plays without it.";
    setPlaying(false);
  });
  hasVideo = true;
  if (data.video === "embedded") {
    const text = atob($("video-data").textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    $("video-data").remove();
    video.src = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
  } else {
    video.src = data.video;
  }
  followVideo();
  video.addEventListener("click", () => setPlaying(!state.playing));
  video.addEventListener("loadedmetadata", drawBody);
}

// --- hands on

/** Pointers on a plot go to that time. */
function seekable(canvas, edges) {
  const go = (event) => {
    const { left, right } = edges();
    const box = canvas.getBoundingClientRect();
    const inner = box.width - left - right;
    seek(Math.floor((event.clientX - box.left - left) / inner * total));
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    go(event);
  });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons & 1) go(event); });
}

function setUpTransport() {
  $("slider").max = total - 1;
  $("slider").addEventListener("input", (event) => seek(+event.target.value));
  $("play").addEventListener("click", () => setPlaying(!state.playing));
  $("speed").addEventListener("change", (event) => {
    state.speed = +event.target.value;
    video.playbackRate = state.speed;
    clock.frame = state.frame;
    clock.start = performance.now();
  });
  $("play").disabled = total < 2;
  people.forEach((p, i) => $("person").add(new Option(p.label, String(i))));
  $("person-pick").hidden = people.length < 2;
  $("person").addEventListener("change", (event) => {
    state.person = +event.target.value;
    choose(state.joint);
    drawBody();
  });
  const step = (by) => () => { setPlaying(false); seek(state.frame + by); };
  const keys = { ArrowLeft: [step(-1), step(-10)], ArrowRight: [step(1), step(10)],
    Home: [() => seek(0)], End: [() => seek(total - 1)],
    " ": [() => setPlaying(!state.playing)] };
  document.addEventListener("keydown", (event) => {
    const tag = event.target.tagName;
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    if (tag === "SELECT" || tag === "SUMMARY" || tag === "INPUT" && event.target.type !== "range" ||
      tag === "BUTTON" && event.key === " ") return;
    event.preventDefault();
    (event.shiftKey && keys[event.key][1] || keys[event.key][0])();
  });
  $("strips").addEventListener("keydown", (event) => {
    const by = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    choose(state.joint + by);
    $("strips").children[state.joint].children[0].focus();
  });
}

function drawAll() {
  look = readColors();
  drawBody();
  drawStrips();
  drawCurves();
  moveCursor();
}

function setUp() {
  const hasTruth = people.some((p) => p.truth);
  $("truth-option").hidden = $("truth-legend").hidden = !hasTruth;
  $("axes-words").textContent = data.frame === "camera"
    ? "Axes are those of the camera: x to the right of the image, y down, z away from the camera. " +
      "The curve of y is drawn so that up is up."
    : "Axes are those of the body: x to the person's left, y down, z to the back. " +
      "The curve of y is drawn so that up is up.";
  for (const id of ["joints", "body-panel", "legend"]) $(id).hidden = people.length === 0;
  if (!people.length) $("stage").classList.add("single");
  $("transport").hidden = !people.length && !data.video;
  buildStrips();
  seekable($("curves"), margins);
  setUpBody();
  setUpTransport();
  setUpVideo();
  choose(0);
  const asked = /^#frame=(\d+)$/.exec(window.location.hash);
  if (asked) seek(+asked[1]); else show(0);
  let width = 0;
  new ResizeObserver(() => {
    if (document.body.clientWidth !== width) { // text that wraps changes the height all the time
      width = document.body.clientWidth;
      drawAll();
    }
  }).observe(document.body);
  new ResizeObserver(drawBody).observe($("body-panel"));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  document.body.dataset.ready = "true";
}

setUp();
