"use strict";
// What was measured: the surface of the gel, which can be turned, and force and depth as a bar and in words.

const VIEW = [640, 440], LIFT = 0.25; // pixels of the view; height of the deepest place, in widths of the picture
const REACH = { "contact, %": [0, 5], "force, N": [0, 1], "depth, mm": [0, 0.2], "depth, widths": [0, 0.01], "slip, %": [0, 100] }; // of their curves at least
const INFERNO = ["#000004", "#420a68", "#932667", "#dd513a", "#fca50a", "#fcffa4"]; // of depth, from none to the deepest
const turned = { about: -0.5, tilt: 0.95 }; // radians, for all surfaces

// Heights from a grey picture. They are smoothed, as its 256 steps are no edges.
function heightsOf(bitmap) {
  const { width, height } = bitmap, g = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  g.drawImage(bitmap, 0, 0);
  const { data } = g.getImageData(0, 0, width, height);
  let heights = new Float32Array(width * height).map((_, i) => data[4 * i] / 255);
  for (const step of [1, width, 1, width]) {
    const before = heights;
    heights = before.map((one, i) => (2 * one + (before[i - step] ?? one) + (before[i + step] ?? one)) / 4);
  }
  return { heights, width, height };
}

// A height field in perspective, lit from the upper left, on a dark ground. Triangles with a depth buffer: it works
// on machines without a graphics card, in some milliseconds.
function drawSurface(canvas) {
  const { heights, width, height } = canvas.surface, [wide, tall] = VIEW, count = width * height;
  if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = VIEW;
  const g = canvas.getContext("2d"), image = g.createImageData(wide, tall), pixels = new Uint32Array(image.data.buffer);
  const near = new Float32Array(wide * tall).fill(-9), x = new Float32Array(count), y = new Float32Array(count), z = new Float32Array(count), light = new Float32Array(count);
  const [sa, ca, st, ct] = [Math.sin(turned.about), Math.cos(turned.about), Math.sin(turned.tilt), Math.cos(turned.tilt)];
  const turn = (a, b, c) => [a * ca - b * sa, (a * sa + b * ca) * ct - c * st, (a * sa + b * ca) * st + c * ct]; // right, down, near
  for (let i = 0; i < count; i++) {
    const column = i % width, row = (i - column) / width, at = (r, c) => heights[Math.min(Math.max(r, 0), height - 1) * width + Math.min(Math.max(c, 0), width - 1)];
    const [right, down, nearer] = turn((column + 0.5) / width - 0.5, (row + 0.5 - height / 2) / width, LIFT * heights[i]);
    const scale = (0.53 * wide * 2.4) / (2.4 - nearer) * Math.min(1, width / height);
    x[i] = wide / 2 + scale * right;
    y[i] = 0.53 * tall + scale * down;
    z[i] = nearer;
    const a = -LIFT * width * (at(row, column + 1) - at(row, column - 1)) / 2, b = -LIFT * width * (at(row + 1, column) - at(row - 1, column)) / 2;
    const [na, nb, nc] = turn(a, b, 1);
    light[i] = 0.25 + 0.75 * Math.max(0, (-0.45 * na - 0.5 * nb + 0.74 * nc) / Math.hypot(a, b, 1));
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
        const depth = p * z[i] + q * z[j] + r * z[k], place = v * wide + u;
        if (depth <= near[place]) continue;
        near[place] = depth;
        const lit = p * light[i] + q * light[j] + r * light[k], high = p * heights[i] + q * heights[j] + r * heights[k];
        pixels[place] = 0xff000000 | ((lit * (214 - 4 * high)) << 16) | ((lit * (210 - 9 * high)) << 8) | (lit * (206 - 108 * high)); // grey to teal
      }
    }
  };
  for (let i = 0; i < count - width; i++) {
    if (i % width === width - 1) continue;
    triangle(i, i + 1, i + width);
    triangle(i + 1, i + width + 1, i + width);
  }
  g.putImageData(image, 0, 0);
}

// A layer on the canvas of a stage. A surface is turned by dragging and by the arrow keys.
function showLayer(canvas, bitmap, isSurface) {
  if (!isSurface) { // numbers and curves stand beside a picture that is higher than wide
    const look = canvas.closest(".look");
    look?.classList.toggle("portrait", bitmap.height > 1.1 * bitmap.width);
    look?.style.setProperty("--wide", bitmap.width / bitmap.height);
  }
  canvas.surface = isSurface ? heightsOf(bitmap) : null;
  canvas.tabIndex = isSurface ? 0 : -1;
  canvas.dataset.own = isSurface ? Object.keys(ARROWS) : "";
  canvas.title = isSurface ? "Drag, or press the arrow keys, to turn it." : "";
  if (isSurface) drawSurface(canvas); else paint(canvas, bitmap);
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
    if (layer === "surface") part.push(`heights are drawn ${(LIFT / one.high).toPrecision(2)} times as high`);
    words.textContent = part.join(", ");
    fault.textContent = one.faults.length ? `Do not trust these values: ${one.faults.join(" ")}` : "";
  };
  show(null);
  return { node, show };
}
