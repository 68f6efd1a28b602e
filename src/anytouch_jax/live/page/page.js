"use strict";
// The page of `anytouch view`. All text from files goes through textContent, so that it stays text.

const COLOURS = ["#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#ee7733", "#009988", "#882255",
  "#999933", "#88ccee", "#cc6677", "#117733", "#ddcc77", "#332288", "#44aa99", "#661100", "#6699cc", "#aa4466",
  "#4b7d2c", "#888888"];
const RATE = 10, AHEAD = 6, KEPT = 900; // frames a second of recordings, frames read ahead, images in memory
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3]]; // lines differ by more than their colour
const LAYERS = { frame: "Image", difference: "Difference", contact: "Contact", depth: "Depth", surface: "Surface" };
const main = document.getElementById("main"), tabs = document.getElementById("tabs");
const state = { sources: [], stop: () => {}, keys: {}, layer: "frame", token: new URLSearchParams(location.hash.slice(1)).get("token") };

function el(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name in node && name !== "list") node[name] = value;
    else node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

function say(text, alarm = false) {
  const status = document.getElementById("status");
  if (status.textContent !== text) status.textContent = text;
  status.className = alarm ? "alarm" : "";
}

async function api(path, options = {}) {
  const headers = { ...(options.headers ?? {}), ...(state.token ? { Authorization: `Bearer ${state.token}` } : {}) };
  const response = await fetch(`api/${path}`, { ...options, headers });
  if (!response.ok) {
    let reason = `the server answered ${response.status}`;
    try { reason = (await response.json()).error ?? reason; } catch { /* no JSON: the status says enough */ }
    throw Object.assign(new Error(reason), { status: response.status });
  }
  return response;
}
const json = async (path) => (await api(path)).json();
// Errors of work that nobody waits for are shown.
const guard = (work) => (...args) => Promise.resolve(work(...args)).catch((error) => {
  if (error.name !== "AbortError") say(error.message, true);
});
const order = (source, body, more = {}) => api(`${source}/control`, {
  method: "POST", body: JSON.stringify(body), headers: { "X-Anytouch": "1" }, ...more,
});

// A command, which is broken between words and never inside an option such as --out.
const command = (text) => el("code", {}, ...text.split(" ").flatMap((word, i) => (i ? [" ", el("span", {}, word)] : [el("span", {}, word)])));

function option(label, values, value, change) {
  const node = el("select", { ariaLabel: label, onchange: () => change(node.value) });
  for (const [key, text] of values) node.append(el("option", { value: key }, text));
  node.value = value;
  return el("label", {}, label, node);
}

// Buttons that choose the layer of all images. Key `l` takes the next one.
function layerBar(names, change) {
  const buttons = names.map((name) => el("button", { onclick: () => choose(name) }, LAYERS[name] ?? name));
  const node = el("div", { className: "layers", role: "group", ariaLabel: "layer" }, ...buttons);
  const mark = () => buttons.forEach((button, i) => button.setAttribute("aria-pressed", names[i] === state.layer));
  const choose = (name) => { state.layer = name; mark(); change(); };
  if (!names.includes(state.layer)) state.layer = names[0];
  mark();
  return { node, next: () => choose(names[(names.indexOf(state.layer) + 1) % names.length]) };
}

function keys(help) {
  state.keys = Object.fromEntries(help.map(([key, , action]) => [key, action]));
  const named = { " ": "Space", ArrowLeft: "←", ArrowRight: "→" };
  const parts = help.flatMap(([key, text]) => [el("kbd", {}, named[key] ?? key), ` ${text}  `]);
  document.getElementById("keys").replaceChildren(...parts);
}

document.addEventListener("keydown", (event) => {
  const tag = event.target.tagName, action = state.keys[event.key];
  if (!action || event.ctrlKey || event.metaKey || event.altKey || ["INPUT", "SELECT"].includes(tag)) return;
  if ((tag === "BUTTON" && event.key === " ") || event.target.dataset.own?.includes(event.key)) return;
  event.preventDefault();
  state.repeated = event.repeat;
  action();
});

// ---- images ------------------------------------------------------------------------------------------------------

class Images {
  // `path` leads to the rows of a source. A fixed `layer` does not follow the buttons.
  constructor(path, layer = null, inTurn = false) { Object.assign(this, { path, layer, inTurn, held: new Map(), last: null }); }
  get(row) {
    const layer = this.layer ?? state.layer, key = `${layer} ${row}`;
    let one = this.held.get(key);
    if (one) return one;
    one = { ready: false };
    const before = this.inTurn ? this.last : null; // live touch leaves no time for several at once
    one.wait = this.last = Promise.resolve(before).then(() => this.load(row, layer, one)).catch((error) => { one.error = error.message; one.ready = true; });
    this.held.set(key, one);
    if (this.held.size > KEPT) {
      const [oldest, gone] = this.held.entries().next().value;
      this.held.delete(oldest);
      gone.bitmap?.close();
    }
    return one;
  }
  async load(row, layer, one) {
    const response = await api(`${this.path}/${row}?layer=${layer}`), score = response.headers.get("X-Score");
    one.bitmap = await createImageBitmap(await response.blob());
    one.score = score ? Number(score) : null;
    one.fields = JSON.parse(response.headers.get("X-Fields"));
    one.isSurface = layer === "surface" && one.fields !== null;
    one.ready = true;
  }
  image(row, ariaLabel) {
    const canvas = el("canvas", { width: 160, height: 120, role: "img", ariaLabel }), one = this.get(row);
    one.wait.then(() => { if (one.bitmap) paint(canvas, one.bitmap); });
    return canvas;
  }
}
const framesOf = (table, layer, inTurn) => new Images(`${table}/frame`, layer, inTurn);

function paint(canvas, bitmap) {
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
}

// A row of a source as a small image that is a button.
function thumbnail(images, row, caption, open, title = "") {
  return el("button", { onclick: open, title }, el("figure", {}, images?.image(row, caption) ?? null, el("figcaption", {}, caption)));
}

async function imageOf(path, alt) {
  const image = el("img", { alt });
  const address = URL.createObjectURL(await (await api(path)).blob());
  image.onload = () => URL.revokeObjectURL(address);
  image.src = address;
  return image;
}

// Contact is a change of the image in grey levels, of which there are 255.
const CONTACT = "contact, %";
const inPercent = (levels) => (levels === null || levels === undefined ? null : levels / 2.55);

// ---- charts ------------------------------------------------------------------------------------------------------

// Numbers of one axis have the same decimals: as many as its range needs.
const decimalsOf = (range) => Math.min(4, Math.max(0, Math.ceil(1 - Math.log10(Math.max(range, 1e-9)))));
// The unit stands behind the comma of a name, such as "force, N".
const unitOf = (name) => name.split(", ")[1] ?? "";
const within = (value) => value !== null && value !== undefined;

// lines: [{values: [y or null], x: [x] or nothing, colour, dash, faint}]; mark: x of a vertical line; level: y of a limit;
// reach: values that the axis shows at least. Where a value is null, the line has a gap.
// With a `length` in frames the chart has the time axis of a slider. Its numbers would lie on the curve, so they are
// returned as text, to stand beside it.
function chart(canvas, lines, { mark = null, level = null, reach = [], log = false, length = 0 } = {}) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return "";
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const g = canvas.getContext("2d"), style = getComputedStyle(document.body);
  g.scale(ratio, ratio);
  const y = (value) => (log ? Math.log10(Math.max(value, 1e-9)) : value);
  const every = lines.flatMap((line) => line.values.filter(within).map(y));
  if (!every.length) return "";
  every.push(...(level === null ? reach : [...reach, level]).map(y));
  let low = every.reduce((a, b) => Math.min(a, b)), high = every.reduce((a, b) => Math.max(a, b));
  if (high - low < 1e-9) { low -= 0.5; high += 0.5; }
  const room = 0.12 * (high - low); // above and below the curve
  const at = (line, i) => (line.x ? line.x[i] : i);
  const right = length ? Math.max(1, length - 1) : Math.max(1, ...lines.map((line) => at(line, line.values.length - 1) ?? 0));
  const left = lines.every((line) => line.x) ? Math.min(...lines.map((line) => line.x[0] ?? right)) : 0;
  const inset = length ? 8 : 52, foot = length ? 5 : 15; // 8: half the thumb of a slider
  const px = (x) => inset + ((width - inset - 8) * (x - left)) / Math.max(right - left, 1e-9);
  const py = (value) => 5 + (height - 5 - foot) * (1 - (value - low + room) / (high - low + 2 * room));
  const decimals = decimalsOf(high - low);
  const text = (value) => {
    const number = log ? 10 ** value : value;
    return log ? Number(number.toPrecision(2)).toString() : number.toFixed(decimals);
  };
  g.strokeStyle = style.getPropertyValue("--line");
  g.strokeRect(inset, 5, width - inset - 8, height - 5 - foot);
  const stroke = (colour, points, dash = []) => {
    g.strokeStyle = colour;
    g.setLineDash(dash);
    g.beginPath();
    let begun = false;
    for (const point of points) {
      if (point && begun) g.lineTo(...point); else if (point) g.moveTo(...point);
      begun = Boolean(point);
    }
    g.stroke();
    g.setLineDash([]);
  };
  if (level !== null) stroke(style.getPropertyValue("--soft"), [[inset, py(y(level))], [width - 8, py(y(level))]], [4, 4]);
  for (const line of lines) {
    const points = line.values.map((value, i) => (within(value) ? [px(at(line, i)), py(y(value))] : null));
    g.lineWidth = 1.5;
    g.globalAlpha = line.faint ? 0.3 : 1;
    stroke(line.colour, points, line.dash);
    g.fillStyle = line.colour;
    // A value between two gaps has no line.
    points.forEach((point, i) => { if (point && !points[i - 1] && !points[i + 1]) g.fillRect(point[0] - 2, point[1] - 2, 4, 4); });
    g.globalAlpha = 1;
  }
  if (mark !== null) stroke(style.getPropertyValue("--text"), [[px(mark), 5], [px(mark), height - foot]]);
  g.font = "12px system-ui, sans-serif";
  g.fillStyle = style.getPropertyValue("--soft");
  if (length) return `${text(low)} to ${text(high)}`;
  g.textAlign = "right";
  g.textBaseline = "middle";
  g.fillText(text(high), 48, Math.max(12, py(high)));
  g.fillText(text(low), 48, Math.min(height - foot - 7, py(low)));
  g.textBaseline = "alphabetic";
  g.fillText(String(right), width - 8, height - 2);
  return "";
}

// A row of a time axis: what it shows and its reach, its curve, and its value now.
function curveRow(name) {
  const canvas = el("canvas", { className: "chart", role: "img", ariaLabel: `${name} over time` }), reach = el("span", { className: "small" }), now = el("span");
  const draw = (lines, options) => { reach.textContent = chart(canvas, lines, options); };
  return { canvas, now, draw, parts: [el("span", { className: "soft" }, name.replaceAll("_", " "), reach), canvas, now] };
}

function swatch(colour, dash) {
  const canvas = el("canvas", { width: 44, height: 20, ariaHidden: "true" }), g = canvas.getContext("2d");
  g.lineWidth = dash ? 5 : 16;
  g.strokeStyle = colour;
  g.setLineDash((dash ?? []).map((length) => 2 * length));
  g.beginPath();
  g.moveTo(0, 10);
  g.lineTo(44, 10);
  g.stroke();
  return canvas;
}
const accent = () => getComputedStyle(document.body).getPropertyValue("--accent");
const looks = (i) => ({ colour: i ? COLOURS[i % COLOURS.length] : accent(), dash: DASHES[i % DASHES.length] });
const legend = (names, lines = false) => names.map((name, i) =>
  el("span", {}, lines ? swatch(looks(i).colour, looks(i).dash) : swatch(COLOURS[i % COLOURS.length]), name));

// ---- recordings --------------------------------------------------------------------------------------------------

function describe(clip, title) {
  const list = el("dl", { className: "small" });
  const add = (name, value) => {
    if (value !== null && value !== undefined) list.append(el("div", {}, el("dt", {}, name), el("dd", {}, String(value))));
  };
  for (const name of ["unit", "object", "split", "dataset", "sequence"]) if (clip[name] !== title) add(name, clip[name]);
  for (const [name, value] of Object.entries(clip.labels)) {
    const short = name.replace("label.", "");
    if (!(name in clip.curves) && value !== clip[short]) add(short, value);
  }
  add("caption", clip.text);
  if (clip.whole > clip.rows.length) add("frames", `the first ${clip.rows.length} of ${clip.whole}`);
  return list;
}

function clipCard(source, clip, images, title) {
  const canvas = el("canvas", { role: "img", ariaLabel: `touch by ${clip.sensor ?? "this sensor"}` });
  const contact = el("span", { className: "soft" }), scores = clip.rows.map(() => null), force = forceBar(), measured = {};
  const words = el("div", { className: "column" }, force.node, describe(clip, title));
  const node = el("section", { className: "clip" }, stage(canvas),
    el("div", { className: "bar" }, clip.sensor ? el("h3", {}, clip.sensor) : null, contact), words);
  if (clip.photo) {
    guard(async () => {
      const image = await imageOf(`${source}/photo/${clip.rows[0]}`, "RGB image of the object");
      node.append(el("figure", { className: "photo" }, image, el("figcaption", {}, "RGB image")));
    })();
  }
  const load = async (t) => {
    const at = Math.min(t, clip.rows.length - 1), one = images.get(clip.rows[at]);
    if (!one.ready) await one.wait;
    if (one.score !== undefined) scores[at] = one.score;
    for (const [name, value] of Object.entries(one.fields?.curves ?? {})) (measured[name] ??= clip.rows.map(() => null))[at] = value;
    return one;
  };
  const show = async (t) => {
    for (let next = t + 1; next <= Math.min(t + AHEAD, clip.rows.length - 1); next++) images.get(clip.rows[next]);
    const one = await load(t), score = one.score ?? null;
    if (one.bitmap) showLayer(canvas, one.bitmap, one.isSurface ? one.fields : null);
    force.show(one.fields, one.isSurface ? "surface" : state.layer);
    const isPressed = one.fields ? one.fields.area > 0 : score > clip.threshold; // as the layer draws it
    contact.textContent = one.error ?? (score === null ? (clip.rows.length > 1 ? "\u00a0" : "") : isPressed ? "● contact" : "○ no contact");
  };
  return { node, words, clip, scores, measured, load, show };
}

// A value beside its curve, with the decimals that the reach of the curve needs.
const DECIMALS = { N: 2, mm: 2, widths: 4, "%": 1 };
const shortened = (number, unit) => {
  if (number === null || number === undefined) return "";
  const shown = unit in DECIMALS ? number.toFixed(DECIMALS[unit]) : Number(number.toPrecision(3)).toString();
  return unit ? `${shown} ${unit}` : shown;
};

// One time axis: the slider, and a curve below it for everything that was measured.
function timeline(cards, length, seek) {
  const slider = el("input", { type: "range", min: 0, max: length - 1, value: 0, ariaLabel: "frame", oninput: () => seek(Number(slider.value)) });
  const playing = el("button", {}, "Play"), clock = el("span", { className: "soft" });
  const seen = el("div", { className: "time" }), labels = el("div", { className: "time" });
  const node = el("section", {}, el("div", { className: "time scrub" }, playing, slider, clock), seen, labels);
  const names = new Set(cards.flatMap((one) => Object.keys(one.clip.curves))), rows = [], added = new Set();
  const addRow = (curves, name, of, level, reach) => {
    const { canvas, now, parts, draw: drawCurve } = curveRow(name);
    const point = (event) => { if (event.buttons) seek(Math.round(((event.offsetX - 8) / (canvas.clientWidth - 16)) * (length - 1))); };
    canvas.addEventListener("pointerdown", point);
    canvas.addEventListener("pointermove", point);
    const unit = unitOf(name);
    curves.append(...parts);
    rows.push((t) => {
      const lines = cards.map((one, i) => ({ values: of(one), ...looks(i) }));
      parts.forEach((part) => { part.hidden = lines.every((line) => line.values.every((each) => each === null)); });
      if (parts[0].hidden) return;
      drawCurve(lines, { mark: t, level, reach, length });
      now.textContent = lines.map((line) => shortened(line.values[Math.min(t, line.values.length - 1)], unit)).join("\n");
    });
  };
  const level = cards.length ? inPercent(cards[0].clip.threshold) : null;
  addRow(seen, CONTACT, (one) => one.scores.map(inPercent), level, REACH[CONTACT]);
  for (const name of names) addRow(labels, name.replace("label.", ""), (one) => one.clip.curves[name] ?? [null], null);
  node.hidden = length < 2;
  const draw = (t) => {
    slider.value = t;
    clock.textContent = `${t + 1} / ${length}`;
    for (const name of new Set(cards.flatMap((one) => Object.keys(one.measured)))) {
      if (added.has(name)) continue;
      addRow(seen, `measured ${name}`, (one) => one.measured[name] ?? [null], null, REACH[name]);
      added.add(name);
    }
    if (length > 1) rows.forEach((row) => row(t));
  };
  return { node, playing, draw };
}

const MANY = 12; // touches from which their thumbnails are shown first

// Thumbnails of the touches that pass the filters. Images are read when they come into view.
function touchGrid(source, filters, open) {
  const images = framesOf(source, "frame"), tiles = el("div", { className: "thumbs" }), more = el("button", {}, "Show more");
  const node = el("div", { className: "column" }, tiles, more);
  let shown = 0, asked = 0;
  const seen = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach(({ target }) => {
    seen.unobserve(target);
    target.querySelector("figure").prepend(images.image(Number(target.dataset.row), target.dataset.name));
    target.querySelector(".blank").remove();
  }), { rootMargin: "200px" });
  const load = guard(async (start) => {
    const mine = ++asked;
    const found = await json(`${source}/touches?start=${start}&filters=${encodeURIComponent(JSON.stringify(filters))}`);
    if (mine !== asked) return;
    if (!start) tiles.replaceChildren();
    for (const one of found.touches) {
      const caption = [one.name, ...one.sensors].join(", ");
      const tile = el("button", { onclick: () => open(one.place) }, el("figure", {}, el("div", { className: "blank" }), el("figcaption", {}, caption)));
      Object.assign(tile.dataset, { row: one.row, name: caption });
      tiles.append(tile);
      seen.observe(tile);
    }
    shown = start + found.touches.length;
    more.hidden = shown >= found.count;
    if (!found.count) tiles.append(el("p", {}, "No touch passes these filters."));
  });
  more.addEventListener("click", () => load(shown));
  return { node, load: () => load(0), stop: () => seen.disconnect() };
}

function showTable(source, about, start = null) {
  const images = framesOf(source), filters = {}, clips = el("div", { className: "clips" }), below = el("div", { className: "column" });
  const look = el("div", { className: "look" }, clips, below);
  let place = start ?? 0, count = 0, isGrid = start === null && about.touches > MANY, cards = [], t = 0, length = 1, timer = null, asked = 0, busy = false, axis = timeline([], 1);
  const title = el("h2"), subtitle = el("p", { className: "soft small" }), number = el("input", { type: "number", min: 1, value: 1, ariaLabel: "number of the touch", onchange: () => go(number.value - 1) });
  const total = el("span", { className: "soft" });
  const pause = () => { clearInterval(timer); timer = null; axis.playing.textContent = "Play"; };
  const play = () => {
    if (t >= length - 1) t = -1;
    timer = setInterval(async () => {
      if (busy) return;
      if (t >= length - 1) { pause(); return; }
      busy = true;
      await move(t + 1);
      busy = false;
    }, 1000 / RATE);
    axis.playing.textContent = "Pause";
  };
  const move = async (to) => {
    t = Math.min(Math.max(to, 0), length - 1);
    const mine = t, shown = cards;
    await Promise.all(cards.map((one) => one.show(mine)));
    if (mine === t && shown === cards) axis.draw(t);
  };
  const measure = async (mine) => { // the whole curve, while nothing else is asked for
    for (let at = 0; at < Math.min(length, KEPT / cards.length); at++) {
      await Promise.all(cards.map((one) => one.load(at)));
      if (mine !== asked) return;
      if (at % 8 === 7 || at === length - 1) axis.draw(t);
    }
  };
  const go = guard(async (to) => {
    pause();
    const mine = ++asked;
    const found = await json(`${source}/touch?place=${Math.max(0, to)}&filters=${encodeURIComponent(JSON.stringify(filters))}`);
    if (mine !== asked) return;
    ({ place, count } = found);
    number.value = count ? place + 1 : 0;
    number.max = count;
    total.textContent = `of ${count.toLocaleString("en")} touches`;
    turning.hidden = about.touches < 2;
    const named = found.clips?.[0]?.object ?? found.name;
    title.textContent = count ? named : "No touch passes these filters.";
    subtitle.textContent = named === found.name ? "" : found.name ?? "";
    cards = found.clips.map((clip) => clipCard(source, clip, images, named));
    length = Math.max(1, ...found.clips.map((clip) => clip.rows.length));
    axis = timeline(cards, length, (at) => { pause(); move(at); });
    axis.playing.addEventListener("click", () => (timer ? pause() : play()));
    clips.replaceChildren(...cards.map((one) => one.node));
    const several = cards.length > 1 && length > 1;
    look.classList.toggle("single", cards.length === 1);
    below.replaceChildren(...(cards.length === 1 ? [cards[0].words] : []), axis.node, ...(several ? [el("div", { className: "legend small" }, ...legend(cards.map((one) => one.clip.sensor ?? ""), true))] : []));
    if (found.more) below.append(el("p", {}, `${found.more} more recordings of this touch are not shown.`));
    say("");
    await move(0);
    if (cards.length && length > 1) await measure(mine);
  });
  const filterBar = el("div", { className: "bar" }), filterBox = el("details", { open: window.innerWidth > 800 && Object.keys(about.filters).length < 7 }, el("summary", {}, "Filters"), filterBar);
  const addFilter = (name, values) => {
    const short = name.replace("label.", "");
    const change = (value) => { if (value) filters[name] = value; else delete filters[name]; place = 0; refresh(); };
    if (values.length <= 60) {
      filterBar.append(option(short, [["", "all"], ...values.map((value) => [value, value])], "", change));
    } else {
      const list = el("datalist", { id: `values-${short}` }, ...values.map((value) => el("option", { value })));
      const input = el("input", { placeholder: "all", onchange: () => change(input.value), list: list.id });
      filterBar.append(el("label", {}, short, input), list);
    }
  };
  const same = (name) => String(about.filters[name]) === String(about.filters[name.replace("label.", "")]);
  Object.keys(about.filters).filter((name) => !name.startsWith("label.") || !same(name)).forEach((name) => addFilter(name, about.filters[name]));
  const step = (by) => () => { if (count && !isGrid) go((place + by + count) % count); };
  const layers = layerBar(about.layers, guard(async () => {
    const slow = setTimeout(() => say("Opening the encoder. This takes some seconds."), 500);
    await move(t);
    clearTimeout(slow);
    say("");
    if (length > 1) await measure(asked);
  }));
  const turning = el("div", { className: "bar", hidden: true }, el("button", { onclick: step(-1), ariaLabel: "previous touch" }, "←"), number, total,
    el("button", { onclick: step(1), ariaLabel: "next touch" }, "→"));
  filterBox.hidden = !filterBar.children.length;
  const one = el("div", { className: "column" }, layers.node, look), all = el("button", { hidden: about.touches < 2, onclick: () => turn(!isGrid) });
  const grid = touchGrid(source, filters, (to) => { place = to; turn(false); });
  const refresh = () => {
    one.hidden = isGrid;
    grid.node.hidden = !isGrid;
    turning.hidden = isGrid || about.touches < 2;
    all.textContent = isGrid ? "One by one" : "All touches";
    if (!isGrid) { go(place); return; }
    pause();
    asked++;
    title.textContent = state.sources[source].name;
    subtitle.textContent = `${about.touches.toLocaleString("en")} touches`;
    grid.load();
  };
  const turn = (toGrid) => { isGrid = toGrid; refresh(); };
  main.replaceChildren(el("div", { className: "bar" }, el("div", {}, title, subtitle), el("div", { className: "bar push" }, all, turning)), filterBox, grid.node, one);
  keys([...(about.touches > 1 ? [["ArrowLeft", "previous touch", step(-1)], ["ArrowRight", "next touch", step(1)]] : []),
    [" ", "play or pause", () => axis.playing.click()], [",", "frame back", () => { pause(); move(t - 1); }],
    [".", "frame on", () => { pause(); move(t + 1); }], ["l", "next layer", layers.next],
    ...(about.touches > 1 ? [["a", "all touches", () => turn(!isGrid)]] : []),
    ...(filterBox.hidden ? [] : [["f", "filters", () => { filterBox.open = true; filterBar.querySelector("select, input")?.focus(); }]])]);
  const resized = () => axis.draw(t);
  window.addEventListener("resize", resized);
  state.stop = () => { pause(); asked++; grid.stop(); window.removeEventListener("resize", resized); };
  refresh();
}

// ---- start -------------------------------------------------------------------------------------------------------

function showStart(source, about) {
  const examples = state.sources.findIndex((one) => one.kind === "table"), thumbs = el("div", { className: "thumbs six" });
  const open = guard(async (camera) => {
    say("Opening the camera and its encoder. This takes some seconds.");
    const { source: place } = await (await order(source, { camera })).json();
    await list();
    select(place);
  });
  const again = el("button", { onclick: guard(async () => { await list(); select(source); }) }, "Look again");
  const cameras = Object.entries(about.cameras).map(([number, name]) => el("li", { className: "bar" },
    el("span", {}, el("b", {}, `Camera ${number}`), ` ${name}`), el("button", { className: "main push", onclick: () => open(number) }, `Open camera ${number}`)));
  const found = cameras.length ? [el("ul", { className: "steps" }, ...cameras)] : [el("p", {}, "No camera was found. Plug in a sensor, then look again.")];
  const step = (text, words) => el("li", {}, el("p", {}, text), command(words));
  const example = el("button", { className: cameras.length ? "" : "main", onclick: () => open(about.example) }, "Play the built-in recording");
  main.replaceChildren(el("h2", {}, "What do you want to see?"), el("div", { className: "split" },
    el("div", { className: "column" },
      el("section", { className: "card" }, el("h3", {}, "A camera"), ...found, again),
      el("section", { className: "card" }, el("h3", {}, "No sensor at hand"),
        el("p", {}, "Two things press a gel in turn. Watch depth and force, and teach their names as you would with a camera."), example)),
    el("section", { className: "card" }, el("h3", {}, "Something else"), el("ul", { className: "steps" },
      step("A video in place of a camera", "anytouch view press.mp4 --live --sensor digit"),
      step("Recordings: a manifest, a folder or a video", "anytouch view recordings"),
      step("Features and their map", "anytouch view manifest.parquet features.npz")))),
    el("h3", {}, "Two presses, each by three sensors"), thumbs);
  guard(async () => {
    const images = framesOf(examples, "frame"), { touches } = state.sources[examples].about;
    for (let place = 0; place < touches; place++) {
      const { clips, name } = await json(`${examples}/touch?place=${place}`);
      thumbs.append(...clips.map((clip) => thumbnail(images, clip.rows[0], `${name}, ${clip.sensor}`, () => select(examples, place))));
    }
  })();
  keys([]);
}

function select(number, place = null) {
  state.stop();
  state.stop = () => {};
  const { kind, about } = state.sources[number];
  const show = { table: showTable, space: showSpace, run: showRun, live: showLive, start: showStart };
  [...tabs.children].forEach((tab, i) => tab.setAttribute("aria-current", i === number));
  main.replaceChildren();
  for (const name of Object.keys(main.dataset)) delete main.dataset[name];
  say("");
  main.focus({ preventScroll: true }); // keys go to the page, and Space not to the tab
  sessionStorage.setItem("tab", number);
  show[kind](number, about, place);
}

async function list() {
  state.sources = await json("sources");
  const words = { space: "features: ", run: "run: ", live: "live: " };
  tabs.replaceChildren(...state.sources.map((one, i) => el("button", { onclick: () => select(i) }, (words[one.kind] ?? "") + one.name)));
}

async function start() {
  try {
    await list();
  } catch (error) {
    if (error.status !== 401) { say(error.message, true); return; }
    const input = el("input", { type: "password", autocomplete: "off" });
    const form = el("form", { className: "bar", onsubmit: (event) => { event.preventDefault(); state.token = input.value; start(); } },
      el("label", {}, "token, from the terminal", input), el("button", {}, "Open"));
    main.replaceChildren(form);
    say(state.token ? error.message : "This page asks for a token.", Boolean(state.token));
    input.focus();
    return;
  }
  const kinds = state.sources.map((one) => one.kind), before = sessionStorage.getItem("tab");
  const first = [before, kinds.indexOf("live"), kinds.indexOf("start"), 0].map((each) => Number(each ?? -1));
  select(first.find((each) => each in kinds));
}
document.addEventListener("DOMContentLoaded", start);
