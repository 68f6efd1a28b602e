"use strict";
// What was measured: the surface of the gel, which can be turned, and force and depth as a bar and in words.

const VIEW = [640, 440]; // pixels of the view
const LIFT = 0.25, EDGE = 3; // height of a whole scale, in widths of the image; cells of the border that are noise
const STEPS = [0.5, 1, 2, 5]; // mm of a whole scale of a surface
const REACH = { "contact, %": [0, 5], "force, N": [0, 1], "depth, mm": [0, 0.2], "depth, widths": [0, 0.01], "slip, %": [0, 100] }; // of their curves at least
const INFERNO = ["#000004", "#420a68", "#932667", "#dd513a", "#fca50a", "#fcffa4"]; // of depth, from none to the deepest
const turned = { about: -0.5, tilt: 0.95 }; // radians, for all surfaces

// Heights in parts of a whole scale, from a grey image whose white is `scale` deep. They are smoothed, because its 256
// steps are no edges, and fall to nothing at the border, where what is measured curls up.
function heightsOf(bitmap, scale, whole) {
  const { width, height } = bitmap, g = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  g.drawImage(bitmap, 0, 0);
  const { data } = g.getImageData(0, 0, width, height);
  let heights = new Float32Array(width * height).map((_, i) => ((data[4 * i] / 255) * scale) / whole);
  const smooth = (across) => {
    const before = heights, last = across ? width - 1 : height - 1, step = across ? 1 : width;
    heights = before.map((one, i) => {
      const place = across ? i % width : Math.floor(i / width); // beyond the border it goes on as at the border
      return (2 * one + before[place > 0 ? i - step : i] + before[place < last ? i + step : i]) / 4;
    });
  };
  [true, false, true, false].forEach(smooth);
  const inside = (place, length) => Math.min(1, Math.min(place, length - 1 - place) / EDGE);
  heights = heights.map((one, i) => one * inside(i % width, width) * inside(Math.floor(i / width), height));
  return { heights, width, height };
}

// A height field in perspective, lit from the upper left, on a dark ground, with bars in mm. Triangles with a depth
// buffer: it works on machines without a graphics card, in some milliseconds. What its size does not change is kept.
const depthBuffer = new Float32Array(VIEW[0] * VIEW[1]);
let vertices = { count: 0 };
function verticesOf(count) {
  if (vertices.count !== count) vertices = { count, ...Object.fromEntries([..."xyzrgb"].map((name) => [name, new Float32Array(count)])) };
  return vertices;
}

function drawSurface(canvas) {
  const { heights, width, height } = canvas.surface, [wide, tall] = VIEW, count = width * height;
  if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = VIEW;
  const g = canvas.getContext("2d"), image = g.createImageData(wide, tall), pixels = new Uint32Array(image.data.buffer);
  const { x, y, z, r, g: green, b } = verticesOf(count);
  depthBuffer.fill(-9);
  const [sa, ca, st, ct] = [Math.sin(turned.about), Math.cos(turned.about), Math.sin(turned.tilt), Math.cos(turned.tilt)];
  const turn = (a, b, c) => [a * ca - b * sa, (a * sa + b * ca) * ct - c * st, (a * sa + b * ca) * st + c * ct]; // right, down, near
  const flat = (a, b, c) => { const [right, down, nearer] = turn(a, b, c), far = 2.4 / (2.4 - nearer); return [far * right, far * down, nearer]; };
  // The plate and a whole scale above it fill the view, whatever its proportions and its turn.
  const side = height / width / 2, corners = [-0.5, 0.5].flatMap((a) => [-side, side].flatMap((b) => [0, LIFT].map((c) => flat(a, b, c))));
  const [rights, downs] = [0, 1].map((i) => corners.map((corner) => corner[i])), [left, right, top, bottom] = [Math.min(...rights), Math.max(...rights), Math.min(...downs), Math.max(...downs)];
  const scale = 0.94 * Math.min(wide / (right - left), tall / (bottom - top)), middle = [wide / 2 - (scale * (left + right)) / 2, tall / 2 - (scale * (top + bottom)) / 2];
  const place = (a, b, c) => { const [u, v, nearer] = flat(a, b, c); return [middle[0] + scale * u, middle[1] + scale * v, nearer]; };
  for (let i = 0; i < count; i++) {
    const column = i % width, row = (i - column) / width;
    [x[i], y[i], z[i]] = place((column + 0.5) / width - 0.5, (row + 0.5 - height / 2) / width, LIFT * heights[i]);
    const across = heights[column < width - 1 ? i + 1 : i] - heights[column > 0 ? i - 1 : i], along = heights[row < height - 1 ? i + width : i] - heights[row > 0 ? i - width : i];
    const tiltA = (-LIFT * width * across) / 2, tiltB = (-LIFT * width * along) / 2, [na, nb, nc] = turn(tiltA, tiltB, 1);
    const facing = Math.max(0, (-0.5 * na - 0.55 * nb + 0.67 * nc) / Math.sqrt(tiltA * tiltA + tiltB * tiltB + 1));
    const light = 0.35 + 0.75 * facing + 0.5 * facing ** 24, high = Math.min(1, heights[i]); // ground light, light, gloss
    r[i] = Math.min(255, light * (86 + 160 * high)); // slate to amber
    green[i] = Math.min(255, light * (112 + 62 * high));
    b[i] = Math.min(255, light * (122 - 70 * high));
  }
  const triangle = (i, j, k) => {
    const area = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]);
    if (Math.abs(area) < 1e-6) return;
    const low = Math.max(0, Math.ceil(Math.min(x[i], x[j], x[k]))), far = Math.min(wide - 1, Math.floor(Math.max(x[i], x[j], x[k])));
    const first = Math.max(0, Math.ceil(Math.min(y[i], y[j], y[k]))), last = Math.min(tall - 1, Math.floor(Math.max(y[i], y[j], y[k])));
    // Weights of the corners are linear in the place, and so is everything that they mix.
    const pu = (y[j] - y[k]) / area, pv = (x[k] - x[j]) / area, qu = (y[k] - y[i]) / area, qv = (x[i] - x[k]) / area;
    const zp = z[i] - z[k], zq = z[j] - z[k], rp = r[i] - r[k], rq = r[j] - r[k], gp = green[i] - green[k], gq = green[j] - green[k], bp = b[i] - b[k], bq = b[j] - b[k];
    for (let v = first; v <= last; v++) {
      let p = (low - x[k]) * pu + (v - y[k]) * pv, q = (low - x[k]) * qu + (v - y[k]) * qv;
      for (let at = v * wide + low, end = v * wide + far; at <= end; at++, p += pu, q += qu) {
        if (p < -1e-4 || q < -1e-4 || p + q > 1.0001) continue;
        const depth = z[k] + p * zp + q * zq;
        if (depth <= depthBuffer[at]) continue;
        depthBuffer[at] = depth;
        pixels[at] = 0xff000000 | ((b[k] + p * bp + q * bq) << 16) | ((green[k] + p * gp + q * gq) << 8) | (r[k] + p * rp + q * rq);
      }
    }
  };
  for (let row = 0; row < height - 1; row++) {
    for (let i = row * width; i < (row + 1) * width - 1; i++) {
      triangle(i, i + 1, i + width);
      triangle(i + 1, i + width + 1, i + width);
    }
  }
  g.putImageData(image, 0, 0);
  drawScale(g, canvas.surface, place);
}

// A bar along the plate's front edge, and one of a whole scale on its corner, in mm.
function drawScale(g, { width, height, whole, unit, wideMm, shownWide }, place) {
  // Letters are 13 px high on the screen, however small the view is shown.
  const size = Math.max(15, Math.round((13 * VIEW[0]) / (shownWide || VIEW[0])));
  const side = height / width / 2, along = wideMm ? 5 / wideMm : 0.25, corner = [-0.5, side], style = getComputedStyle(document.body);
  const bar = (from, to, text, shift) => {
    const [a, b] = [place(...from), place(...to)];
    g.strokeStyle = g.fillStyle = style.getPropertyValue("--text");
    g.lineWidth = 3;
    g.beginPath();
    g.moveTo(a[0], a[1]);
    g.lineTo(b[0], b[1]);
    g.stroke();
    g.font = `${size}px system-ui, sans-serif`;
    const u = Math.min(VIEW[0] - 4 * size, Math.max(6, (a[0] + b[0]) / 2 + shift[0])), v = Math.min(VIEW[1] - 6, Math.max(size + 3, (a[1] + b[1]) / 2 + shift[1]));
    g.lineWidth = 4;
    g.strokeStyle = style.backgroundColor;
    g.strokeText(text, u, v);
    g.fillText(text, u, v);
  };
  if (wideMm) bar([...corner, 0], [corner[0] + along, corner[1], 0], "5 mm", [-14, size + 7]);
  bar([...corner, 0], [...corner, LIFT], `${unit === "mm" ? whole : whole.toFixed(3)} ${unit}`, [8, -4]);
}

// A layer on the canvas of a stage, or the surface of what was measured. It is turned by dragging and by arrow keys.
function showLayer(canvas, bitmap, measured) {
  const isSurface = Boolean(measured);
  const ratio = bitmap.width / bitmap.height;
  if (!isSurface && canvas.ratio !== ratio) { // numbers and curves stand beside an image that is higher than wide
    canvas.ratio = ratio; // no style is set for a frame like the last one: the page would be laid out again
    const look = canvas.closest(".look");
    look?.classList.toggle("portrait", ratio < 1 / 1.1);
    look?.style.setProperty("--wide", ratio);
  }
  if (isSurface) {
    const { scale, unit, high } = measured, enough = unit === "mm" ? STEPS.find((step) => step >= scale) ?? scale : scale;
    // The scale grows, and stays: a press that comes and goes would otherwise look equally high all the time.
    canvas.whole = canvas.unit === unit ? Math.max(canvas.whole, enough) : enough;
    canvas.unit = unit;
    if (!canvas.wasSurface) canvas.shownWide = canvas.clientWidth; // once, since it may lay the page out
    canvas.surface = { shownWide: canvas.shownWide, ...heightsOf(bitmap, scale, canvas.whole), whole: canvas.whole, unit, wideMm: unit === "mm" ? scale / high : null };
    drawSurface(canvas);
  } else {
    canvas.surface = null;
    paint(canvas, bitmap);
  }
  if (canvas.wasSurface === isSurface) return;
  canvas.wasSurface = isSurface;
  canvas.tabIndex = isSurface ? 0 : -1;
  canvas.dataset.own = isSurface ? Object.keys(ARROWS) : "";
  canvas.title = isSurface ? "Drag, or press the arrow keys, to turn it." : "";
}
const ARROWS = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] };
function turnBy(right, down) {
  turned.about -= 0.008 * right;
  turned.tilt = Math.min(1.5, Math.max(0, turned.tilt - 0.008 * down));
  document.querySelectorAll(".stage canvas").forEach((one) => { if (one.surface) drawSurface(one); });
}
const stage = (canvas) => {
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => { if (event.buttons && canvas.surface) turnBy(event.movementX, event.movementY); });
  canvas.addEventListener("keydown", (event) => {
    if (!canvas.surface || !ARROWS[event.key]) return;
    event.preventDefault();
    turnBy(...ARROWS[event.key]);
  });
  return el("div", { className: "stage" }, canvas);
};

// Force as a bar, and depth and area in words. `show` takes what was measured of a frame, or nothing.
function forceBar() {
  const bar = el("i", { className: "ours" }), value = el("span"), words = el("p", { className: "soft small" }), doubt = el("p", { className: "soft small" }), fault = el("p", { className: "alarm small" });
  const bars = el("div", { className: "bars small" }, el("span", {}, "force"), el("span", { className: "track" }, bar), value);
  const ramp = el("canvas", { width: 120, height: 10, role: "img", ariaLabel: "colours from no depth to the deepest" }), deepest = el("span");
  const scale = el("p", { className: "scale small" }, el("span", {}, "depth 0"), ramp, deepest);
  const node = el("div", { className: "force" }, fault, bars, words, doubt, scale);
  const g = ramp.getContext("2d"), colours = g.createLinearGradient(0, 0, 120, 0);
  INFERNO.forEach((colour, i) => colours.addColorStop(i / (INFERNO.length - 1), colour));
  g.fillStyle = colours;
  g.fillRect(0, 0, 120, 10);
  let most = 10; // N of a whole bar
  const show = (one, layer = "frame", note = "") => {
    node.hidden = !one;
    if (!one) return;
    scale.hidden = layer !== "depth";
    deepest.textContent = `${one.scale.toFixed(one.unit === "mm" ? 2 : 4)} ${one.unit}`;
    bars.hidden = !one.force;
    const part = [], off = (number, std, digits) => `${number.toFixed(digits)} ± ${std.toFixed(digits)}`;
    if (one.force) {
      const [right, down, normal] = one.force, sideways = Math.hypot(right, down);
      most = Math.max(most, normal);
      bar.style.width = `${Math.max(0, (100 * normal) / most)}%`;
      value.textContent = `${normal.toFixed(1)} N`;
      part.push(`90 % from ${one.force_low.toFixed(1)} to ${one.force_high.toFixed(1)} N`);
      const arrow = sideways > Math.max(one.sideways_std, 0.05) ? ` ${"→↘↓↙←↖↑↗"[Math.round((4 * Math.atan2(down, right)) / Math.PI + 8) % 8]}` : ""; // none beside 0.0 N
      part.push(`sideways${arrow} ${off(sideways, one.sideways_std, 1)} N`);
    }
    part.push(`depth ${off(one.depth, one.depth_std, one.unit === "mm" ? 2 : 4)} ${one.unit}`);
    part.push(one.unit === "mm" ? `contact ${one.area.toFixed(0)} mm²` : "no mm and N, since the sensor is not known");
    words.textContent = part.join(", ");
    const isFaulty = one.faults.length > 0; // then it is no guess
    doubt.textContent = note || (isFaulty ? "" : (one.calibrated || one.unit !== "mm" ? "" : `Of ${one.case}: mm and N are a first guess until a ball and a weight calibrate it.`));
    fault.textContent = isFaulty ? `Do not trust these values: ${one.faults.join(" ")}` : "";
  };
  show(null);
  return { node, show };
}
