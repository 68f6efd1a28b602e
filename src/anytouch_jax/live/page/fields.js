"use strict";
// What was measured: the surface of the gel, which can be turned, and force and depth as a bar and in words.

const VIEW = [640, 440]; // pixels of the view
const LIFT = 0.25, EDGE = 3; // height of a whole scale, in widths of the picture; cells of the border that are noise
const STEPS = [0.5, 1, 2, 5]; // mm of a whole scale of a surface
const REACH = { "contact, %": [0, 5], "force, N": [0, 1], "depth, mm": [0, 0.2], "depth, widths": [0, 0.01], "slip, %": [0, 100] }; // of their curves at least
const INFERNO = ["#000004", "#420a68", "#932667", "#dd513a", "#fca50a", "#fcffa4"]; // of depth, from none to the deepest
const turned = { about: -0.5, tilt: 0.95 }; // radians, for all surfaces

// Heights in parts of a whole scale, from a grey picture whose white is `scale` deep. They are smoothed, because its 256
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
// buffer: it works on machines without a graphics card, in some milliseconds.
function drawSurface(canvas) {
  const { heights, width, height } = canvas.surface, [wide, tall] = VIEW, count = width * height;
  if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = VIEW;
  const g = canvas.getContext("2d"), image = g.createImageData(wide, tall), pixels = new Uint32Array(image.data.buffer);
  const near = new Float32Array(wide * tall).fill(-9), x = new Float32Array(count), y = new Float32Array(count), z = new Float32Array(count), light = new Float32Array(count);
  const [sa, ca, st, ct] = [Math.sin(turned.about), Math.cos(turned.about), Math.sin(turned.tilt), Math.cos(turned.tilt)];
  const turn = (a, b, c) => [a * ca - b * sa, (a * sa + b * ca) * ct - c * st, (a * sa + b * ca) * st + c * ct]; // right, down, near
  const flat = (a, b, c) => { const [right, down, nearer] = turn(a, b, c), far = 2.4 / (2.4 - nearer); return [far * right, far * down, nearer]; };
  // The plate and a whole scale above it fill the view, whatever its proportions and its turn.
  const side = height / width / 2, corners = [-0.5, 0.5].flatMap((a) => [-side, side].flatMap((b) => [0, LIFT].map((c) => flat(a, b, c))));
  const [rights, downs] = [0, 1].map((i) => corners.map((corner) => corner[i])), [left, right, top, bottom] = [Math.min(...rights), Math.max(...rights), Math.min(...downs), Math.max(...downs)];
  const scale = 0.94 * Math.min(wide / (right - left), tall / (bottom - top)), middle = [wide / 2 - (scale * (left + right)) / 2, tall / 2 - (scale * (top + bottom)) / 2];
  const place = (a, b, c) => { const [u, v, nearer] = flat(a, b, c); return [middle[0] + scale * u, middle[1] + scale * v, nearer]; };
  for (let i = 0; i < count; i++) {
    const column = i % width, row = (i - column) / width, at = (r, c) => heights[Math.min(Math.max(r, 0), height - 1) * width + Math.min(Math.max(c, 0), width - 1)];
    [x[i], y[i], z[i]] = place((column + 0.5) / width - 0.5, (row + 0.5 - height / 2) / width, LIFT * heights[i]);
    const a = -LIFT * width * (at(row, column + 1) - at(row, column - 1)) / 2, b = -LIFT * width * (at(row + 1, column) - at(row - 1, column)) / 2;
    const [na, nb, nc] = turn(a, b, 1), long = Math.hypot(a, b, 1), facing = Math.max(0, (-0.5 * na - 0.55 * nb + 0.67 * nc) / long);
    light[i] = 0.35 + 0.75 * facing + 0.5 * facing ** 24; // ground light, light, gloss
  }
  const triangle = (i, j, k) => {
    const area = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]);
    if (Math.abs(area) < 1e-6) return;
    const left = Math.max(0, Math.ceil(Math.min(x[i], x[j], x[k]))), right = Math.min(wide - 1, Math.floor(Math.max(x[i], x[j], x[k])));
    const top = Math.max(0, Math.ceil(Math.min(y[i], y[j], y[k]))), bottom = Math.min(tall - 1, Math.floor(Math.max(y[i], y[j], y[k])));
    for (let v = top; v <= bottom; v++) {
      for (let u = left; u <= right; u++) {
        const p = ((x[j] - u) * (y[k] - v) - (x[k] - u) * (y[j] - v)) / area, q = ((x[k] - u) * (y[i] - v) - (x[i] - u) * (y[k] - v)) / area, r = 1 - p - q;
        if (p < -1e-4 || q < -1e-4 || r < -1e-4) continue;
        const depth = p * z[i] + q * z[j] + r * z[k], at = v * wide + u;
        if (depth <= near[at]) continue;
        near[at] = depth;
        const lit = p * light[i] + q * light[j] + r * light[k], high = Math.min(1, p * heights[i] + q * heights[j] + r * heights[k]);
        const red = Math.min(255, lit * (86 + 160 * high)), green = Math.min(255, lit * (112 + 62 * high)), blue = Math.min(255, lit * (122 - 70 * high)); // slate to amber
        pixels[at] = 0xff000000 | (blue << 16) | (green << 8) | red;
      }
    }
  };
  for (let i = 0; i < count - width; i++) {
    if (i % width === width - 1) continue;
    triangle(i, i + 1, i + width);
    triangle(i + 1, i + width + 1, i + width);
  }
  g.putImageData(image, 0, 0);
  drawScale(g, canvas.surface, place);
}

// A bar along the plate's front edge, and one of a whole scale on its corner, in mm.
function drawScale(g, { width, height, whole, unit, wideMm }, place) {
  const side = height / width / 2, along = wideMm ? 5 / wideMm : 0.25, corner = [-0.5, side], style = getComputedStyle(document.body);
  const bar = (from, to, text, shift) => {
    const [a, b] = [place(...from), place(...to)];
    g.strokeStyle = g.fillStyle = style.getPropertyValue("--text");
    g.lineWidth = 3;
    g.beginPath();
    g.moveTo(a[0], a[1]);
    g.lineTo(b[0], b[1]);
    g.stroke();
    g.font = "15px system-ui, sans-serif";
    const u = Math.min(VIEW[0] - 62, Math.max(6, (a[0] + b[0]) / 2 + shift[0])), v = Math.min(VIEW[1] - 6, Math.max(18, (a[1] + b[1]) / 2 + shift[1]));
    g.lineWidth = 4;
    g.strokeStyle = style.backgroundColor;
    g.strokeText(text, u, v);
    g.fillText(text, u, v);
  };
  if (wideMm) bar([...corner, 0], [corner[0] + along, corner[1], 0], "5 mm", [-14, 22]);
  bar([...corner, 0], [...corner, LIFT], `${unit === "mm" ? whole : whole.toFixed(3)} ${unit}`, [8, -4]);
}

// A layer on the canvas of a stage, or the surface of what was measured. It is turned by dragging and by arrow keys.
function showLayer(canvas, bitmap, measured) {
  const isSurface = Boolean(measured);
  const ratio = bitmap.width / bitmap.height;
  if (!isSurface && canvas.ratio !== ratio) { // numbers and curves stand beside a picture that is higher than wide
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
    canvas.surface = { ...heightsOf(bitmap, scale, canvas.whole), whole: canvas.whole, unit, wideMm: unit === "mm" ? scale / high : null };
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
  const bar = el("i", { className: "ours" }), value = el("span"), words = el("p", { className: "soft small" }), fault = el("p", { className: "soft small" });
  const bars = el("div", { className: "bars small" }, el("span", {}, "force"), el("span", { className: "track" }, bar), value);
  const ramp = el("canvas", { width: 120, height: 10, role: "img", ariaLabel: "colours from no depth to the deepest" }), deepest = el("span");
  const scale = el("p", { className: "scale small" }, el("span", {}, "depth 0"), ramp, deepest);
  const node = el("div", { className: "force" }, bars, words, scale, fault);
  const g = ramp.getContext("2d"), colours = g.createLinearGradient(0, 0, 120, 0);
  INFERNO.forEach((colour, i) => colours.addColorStop(i / (INFERNO.length - 1), colour));
  g.fillStyle = colours;
  g.fillRect(0, 0, 120, 10);
  let most = 10; // N of a whole bar
  const show = (one, layer = "frame") => {
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
      part.push(`90 % from ${one.force_low.toFixed(1)} to ${one.force_high.toFixed(1)} N (${one.case})`);
      const arrow = sideways > one.sideways_std ? ` ${"→↘↓↙←↖↑↗"[Math.round((4 * Math.atan2(down, right)) / Math.PI + 8) % 8]}` : "";
      part.push(`sideways${arrow} ${off(sideways, one.sideways_std, 1)} N`);
    }
    part.push(`depth ${off(one.depth, one.depth_std, one.unit === "mm" ? 2 : 4)} ${one.unit}`);
    part.push(one.unit === "mm" ? `contact ${one.area.toFixed(0)} mm²` : "no mm and N, since the sensor is not known");
    words.textContent = part.join(", ");
    fault.textContent = one.faults.length ? `Do not trust these values: ${one.faults.join(" ")}` : "";
  };
  show(null);
  return { node, show };
}
