"use strict";
// The page of `anytouch view`. All text from files goes through textContent, so that it stays text.

const COLOURS = ["#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#ee7733", "#009988", "#882255",
  "#999933", "#88ccee", "#cc6677", "#117733", "#ddcc77", "#332288", "#44aa99", "#661100", "#6699cc", "#aa4466",
  "#4b7d2c", "#888888"];
const RATE = 10, AHEAD = 6, KEPT = 900; // frames a second of recordings, frames read ahead, pictures in memory
const main = document.getElementById("main"), tabs = document.getElementById("tabs");
const state = { sources: [], stop: () => {}, keys: {}, token: new URLSearchParams(location.hash.slice(1)).get("token") };

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
const order = (source, body) => api(`${source}/control`, {
  method: "POST", body: JSON.stringify(body), headers: { "X-Anytouch": "1" },
});

function option(label, values, value, change) {
  const node = el("select", { ariaLabel: label, onchange: () => change(node.value) });
  for (const [key, text] of values) node.append(el("option", { value: key }, text));
  node.value = value;
  return el("label", {}, label, node);
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
  action();
});

// ---- pictures ----------------------------------------------------------------------------------------------------

class Pictures {
  constructor(source, inTurn = false) { this.source = source; this.held = new Map(); this.inTurn = inTurn; this.last = null; }
  get(row) {
    let one = this.held.get(row);
    if (one) return one;
    one = { ready: false };
    const before = this.inTurn ? this.last : null; // live touch leaves no time for several at once
    one.wait = this.last = Promise.resolve(before).then(() => this.load(row, one)).catch((error) => { one.error = error.message; one.ready = true; });
    this.held.set(row, one);
    if (this.held.size > KEPT) {
      const [oldest, gone] = this.held.entries().next().value;
      this.held.delete(oldest);
      gone.bitmap?.close();
    }
    return one;
  }
  async load(row, one) {
    const response = await api(`${this.source}/frame/${row}`), score = response.headers.get("X-Score");
    one.bitmap = await createImageBitmap(await response.blob());
    one.panels = Number(response.headers.get("X-Panels"));
    one.score = score ? Number(score) : null;
    one.ready = true;
  }
}

function panelSet(titles = ["frame", "difference from untouched gel", "contact"]) {
  const canvases = titles.map(() => el("canvas", { width: 160, height: 120 }));
  const figures = titles.map((title, i) => el("figure", {}, canvases[i], el("figcaption", {}, title)));
  const node = el("div", { className: "panels" }, ...figures);
  const draw = (one) => {
    if (!one.bitmap) {
      if (one.error) figures[0].lastChild.textContent = one.error;
      return;
    }
    const width = one.bitmap.width / one.panels;
    canvases.forEach((canvas, i) => {
      figures[i].hidden = i >= one.panels;
      if (i >= one.panels) return;
      if (canvas.width !== width || canvas.height !== one.bitmap.height) {
        canvas.width = width;
        canvas.height = one.bitmap.height;
      }
      canvas.getContext("2d").drawImage(one.bitmap, i * width, 0, width, canvas.height, 0, 0, width, canvas.height);
    });
  };
  return { node, draw };
}

async function picture(path, alt) {
  const image = el("img", { alt });
  const address = URL.createObjectURL(await (await api(path)).blob());
  image.onload = () => URL.revokeObjectURL(address);
  image.src = address;
  return image;
}

// ---- charts ------------------------------------------------------------------------------------------------------

// lines: [{name, values: [y or null], x: [x] or nothing, colour}]; mark: x of a vertical line; level: y of a limit
function chart(canvas, lines, { mark = null, level = null, log = false } = {}) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const g = canvas.getContext("2d"), style = getComputedStyle(document.body);
  g.scale(ratio, ratio);
  const y = (value) => (log ? Math.log10(Math.max(value, 1e-9)) : value);
  const every = lines.flatMap((line) => line.values.filter((value) => value !== null).map(y));
  if (level !== null) every.push(y(level));
  if (!every.length) return;
  let low = every.reduce((a, b) => Math.min(a, b)), high = every.reduce((a, b) => Math.max(a, b));
  if (high - low < 1e-9) { low -= 0.5; high += 0.5; }
  const at = (line, i) => (line.x ? line.x[i] : i);
  const right = Math.max(1, ...lines.map((line) => at(line, line.values.length - 1) ?? 0));
  const left = lines.every((line) => line.x) ? Math.min(...lines.map((line) => line.x[0] ?? right)) : 0;
  const px = (x) => 44 + ((width - 50) * (x - left)) / Math.max(right - left, 1e-9);
  const py = (value) => 5 + (height - 20) * (1 - (value - low) / (high - low));
  const text = (value) => {
    const number = log ? 10 ** value : value;
    return number && Math.abs(number) < 0.01 ? number.toExponential(0) : Number(number.toPrecision(2)).toString();
  };
  g.font = "11px system-ui, sans-serif";
  g.fillStyle = style.getPropertyValue("--soft");
  g.textAlign = "right";
  g.fillText(text(high), 40, 13);
  g.fillText(text(low), 40, height - 14);
  g.fillText(String(right), width - 4, height - 2);
  g.strokeStyle = style.getPropertyValue("--line");
  g.strokeRect(44, 5, width - 50, height - 20);
  const stroke = (colour, points, dash = []) => {
    g.strokeStyle = colour;
    g.setLineDash(dash);
    g.beginPath();
    points.forEach((point, i) => (i ? g.lineTo(...point) : g.moveTo(...point)));
    g.stroke();
    g.setLineDash([]);
  };
  if (level !== null) stroke(style.getPropertyValue("--soft"), [[44, py(y(level))], [width - 6, py(y(level))]], [4, 4]);
  for (const line of lines) {
    const points = line.values.map((value, i) => (value === null ? null : [px(at(line, i)), py(y(value))]));
    const drawn = points.filter((point) => point);
    g.lineWidth = 1.5;
    stroke(line.colour, drawn);
    if (drawn.length === 1) { g.fillStyle = line.colour; g.fillRect(drawn[0][0] - 2, drawn[0][1] - 2, 4, 4); }
  }
  if (mark !== null) stroke(style.getPropertyValue("--text"), [[px(mark), 5], [px(mark), height - 15]]);
}

function swatch(colour) {
  const canvas = el("canvas", { width: 8, height: 8 }), g = canvas.getContext("2d");
  g.fillStyle = colour;
  g.fillRect(0, 0, 8, 8);
  return canvas;
}
const legend = (names) => names.map((name, i) => el("span", {}, swatch(COLOURS[i % COLOURS.length]), name));

// ---- recordings --------------------------------------------------------------------------------------------------

function describe(clip) {
  const list = el("dl");
  const add = (name, value) => {
    if (value !== null && value !== undefined) list.append(el("dt", {}, name), el("dd", {}, String(value)));
  };
  for (const name of ["unit", "object", "split", "dataset", "sequence"]) add(name, clip[name]);
  for (const [name, value] of Object.entries(clip.labels)) {
    const short = name.replace("label.", "");
    if (!(name in clip.curves) && value !== clip[short]) add(short, value);
  }
  add("caption", clip.text);
  add("background", clip.background ? "a picture of the untouched gel" : "the first frame");
  if (clip.whole > clip.rows.length) add("frames", `the first ${clip.rows.length} of ${clip.whole}`);
  return list;
}

function clipCard(source, clip, pictures) {
  const panels = panelSet(), charts = el("div", { className: "charts" }), scores = clip.rows.map(() => null), drawn = [];
  const addChart = (name, lines, level) => {
    const canvas = el("canvas", { className: "chart", role: "img", ariaLabel: name });
    charts.append(el("figure", {}, el("figcaption", {}, name), canvas));
    drawn.push((t) => chart(canvas, lines, { mark: t, level }));
  };
  addChart("contact score, and its limit", [{ values: scores, colour: COLOURS[6] }], clip.threshold);
  Object.entries(clip.curves).forEach(([name, values], i) =>
    addChart(name.replace("label.", ""), [{ values, colour: COLOURS[i] }], null));
  const card = el("section", { className: "card" }, el("h2", {}, clip.sensor), panels.node, charts, describe(clip));
  if (clip.photo) {
    guard(async () => {
      const image = await picture(`${source}/photo/${clip.rows[0]}`, "photograph of the object");
      card.append(el("figure", { className: "photo" }, image, el("figcaption", {}, "photograph")));
    })();
  }
  const show = (t) => {
    const at = Math.min(t, clip.rows.length - 1), one = pictures.get(clip.rows[at]);
    const draw = () => {
      if (one.score !== undefined) scores[at] = one.score;
      panels.draw(one);
      charts.hidden = scores.every((score) => score === null) && !Object.keys(clip.curves).length;
      drawn.forEach((each) => each(at));
    };
    for (let next = at + 1; next <= Math.min(at + AHEAD, clip.rows.length - 1); next++) pictures.get(clip.rows[next]);
    return one.ready ? draw() : one.wait.then(draw);
  };
  return { card, show };
}

function showTable(source, about, start = 0) {
  const pictures = new Pictures(source), filters = {}, clips = el("div", { className: "cards" });
  let place = start, count = 0, cards = [], t = 0, length = 1, timer = null, asked = 0, busy = false;
  const title = el("h2"), number = el("input", { type: "number", min: 1, value: 1, onchange: () => go(number.value - 1) });
  const total = el("span", { className: "soft" });
  const slider = el("input", { type: "range", min: 0, value: 0, oninput: () => { pause(); move(Number(slider.value)); } });
  const playing = el("button", { onclick: () => (timer ? pause() : play()) }, "Play");
  const pause = () => { clearInterval(timer); timer = null; playing.textContent = "Play"; };
  const play = () => {
    if (t >= length - 1) t = -1;
    timer = setInterval(async () => {
      if (busy) return;
      if (t >= length - 1) { pause(); return; }
      busy = true;
      await move(t + 1);
      busy = false;
    }, 1000 / RATE);
    playing.textContent = "Pause";
  };
  const move = async (to) => {
    t = Math.min(Math.max(to, 0), length - 1);
    slider.value = t;
    await Promise.all(cards.map((one) => one.show(t)));
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
    title.textContent = count ? found.name : "No touch passes these filters.";
    cards = found.clips.map((clip) => clipCard(source, clip, pictures));
    clips.replaceChildren(...cards.map((one) => one.card));
    if (found.more) clips.append(el("p", {}, `${found.more} more recordings of this touch are not shown.`));
    length = Math.max(1, ...found.clips.map((clip) => clip.rows.length));
    slider.max = length - 1;
    say("");
    await move(0);
  });
  const filterBar = el("div", { className: "bar" });
  const addFilter = (name, values) => {
    const short = name.replace("label.", "");
    const change = (value) => { if (value) filters[name] = value; else delete filters[name]; go(0); };
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
  const step = (by) => () => { if (count) go((place + by + count) % count); };
  main.replaceChildren(
    filterBar,
    el("div", { className: "bar" }, el("button", { onclick: step(-1) }, "← Previous"), number, total,
      el("button", { onclick: step(1) }, "Next →"), playing, el("label", {}, "frame", slider)),
    title, clips);
  keys([["ArrowLeft", "previous touch", step(-1)], ["ArrowRight", "next touch", step(1)],
    [" ", "play or pause", () => playing.click()], [",", "frame back", () => { pause(); move(t - 1); }],
    [".", "frame on", () => { pause(); move(t + 1); }], ["f", "filters", () => filterBar.querySelector("select, input")?.focus()]]);
  const resized = () => cards.forEach((one) => one.show(t));
  window.addEventListener("resize", resized);
  state.stop = () => { pause(); window.removeEventListener("resize", resized); };
  go(place);
}

// ---- features ----------------------------------------------------------------------------------------------------

function hitCard(about, hit, pictures, open) {
  const figure = el("figure", {}), text = [hit.about.sensor, hit.about.object, hit.cosine?.toFixed(3)];
  const canvas = el("canvas", { width: 110, height: 80 });
  if (pictures) {
    figure.append(canvas);
    const one = pictures.get(hit.table_row);
    one.wait.then(() => {
      if (!one.bitmap) return;
      canvas.width = one.bitmap.width / one.panels;
      canvas.height = one.bitmap.height;
      canvas.getContext("2d").drawImage(one.bitmap, 0, 0);
    });
  }
  figure.append(el("figcaption", {}, text.filter((part) => part).join(", ")));
  figure.append(el("button", { onclick: open, title: Object.entries(hit.about).map((pair) => pair.join(": ")).join("\n") }, "Show"));
  return figure;
}

function showSpace(source, about) {
  let points = null, colours = null, chosen = -1, method = "pca", timer = null, marked = [];
  let column = ["sensor", "object"].find((name) => about.columns.includes(name)) ?? about.columns[0] ?? "";
  const pictures = about.table === null ? null : new Pictures(about.table);
  const names = el("div", { className: "legend" }), side = el("div"), others = el("input", { type: "checkbox", checked: true });
  const map = el("canvas", { className: "map", tabIndex: 0, role: "img",
    ariaLabel: "Map of the features. Arrow keys choose a neighbouring point." });
  map.dataset.own = "ArrowLeft ArrowRight ArrowUp ArrowDown";
  const at = (i, size) => [size / 2 + points.x[i] * size * 0.47, size / 2 - points.y[i] * size * 0.47];
  const colourOf = (i) => {
    if (colours.codes) return COLOURS[colours.codes[i] % COLOURS.length];
    const value = colours.values[i];
    return value === null ? "#888888" : `hsl(${250 - 250 * ((value - colours.low) / (colours.high - colours.low || 1))} 75% 50%)`;
  };
  const draw = () => {
    if (!points || !colours) return;
    const ratio = window.devicePixelRatio || 1, size = map.clientWidth, g = map.getContext("2d");
    map.width = map.height = size * ratio;
    g.scale(ratio, ratio);
    const radius = Math.max(1.6, Math.min(4, 120 / Math.sqrt(points.x.length)));
    const dot = (i, r) => { g.beginPath(); g.arc(...at(i, size), r, 0, 7); };
    for (let i = 0; i < points.x.length; i++) { g.fillStyle = colourOf(i); dot(i, radius); g.fill(); }
    g.strokeStyle = getComputedStyle(document.body).getPropertyValue("--text");
    g.lineWidth = 1.5;
    for (const row of marked) { const i = points.rows.indexOf(row); if (i >= 0) { dot(i, radius + 3); g.stroke(); } }
    g.lineWidth = 3;
    if (chosen >= 0) { dot(chosen, radius + 5); g.stroke(); }
  };
  const choose = guard(async (i) => {
    if (i < 0) return;
    chosen = i;
    draw();
    const found = await json(`${source}/neighbours?row=${points.rows[i]}&others=${others.checked ? 1 : 0}`);
    marked = found.hits.map((hit) => hit.row);
    draw();
    const open = (hit) => () => guard(async () => {
      const touch = await json(`${about.table}/touch?row=${hit.table_row}`);
      select(about.table, touch.place);
    })();
    const list = el("dl");
    for (const [name, value] of Object.entries(found.row.about)) {
      const short = name.replace("label.", "");
      if (short === name || value !== found.row.about[short]) list.append(el("dt", {}, short), el("dd", {}, value));
    }
    clearInterval(timer);
    const parts = [];
    if (pictures) {
      const panels = panelSet(), touch = await json(`${about.table}/touch?row=${found.row.table_row}`);
      const clip = touch.clips.find((each) => each.rows.includes(found.row.table_row)) ?? touch.clips[0];
      let t = clip.rows.indexOf(found.row.table_row);
      pictures.get(found.row.table_row).wait.then(() => panels.draw(pictures.get(found.row.table_row)));
      timer = setInterval(() => {
        const one = pictures.get(clip.rows[(t = (t + 1) % clip.rows.length)]);
        if (one.ready) panels.draw(one); else t--;
      }, 2000 / RATE);
      parts.push(panels.node, el("button", { onclick: open(found.row) }, "Show this touch"));
    } else {
      parts.push(el("p", { className: "soft" }, "Name the manifest too, and you see the pictures."));
    }
    const cards = found.hits.map((hit) => hitCard(about, hit, pictures, pictures ? open(hit) : () => choose(points.rows.indexOf(hit.row))));
    side.replaceChildren(el("h2", {}, `Row ${found.row.row}`), ...parts,
      el("h2", {}, `${cards.length} nearest, of ${others.checked ? "other sensors" : "other recordings"}`),
      el("div", { className: "thumbs" }, ...cards), list);
  });
  const nearest = (x, y, size, allowed = () => true) => {
    let best = -1, least = Infinity;
    for (let i = 0; i < points.x.length; i++) {
      const [a, b] = at(i, size), distance = (a - x) ** 2 + (b - y) ** 2;
      if (distance < least && allowed(a, b, i)) { least = distance; best = i; }
    }
    return best;
  };
  map.addEventListener("click", (event) => { if (points) choose(nearest(event.offsetX, event.offsetY, map.clientWidth)); });
  map.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way || !points) return;
    event.preventDefault();
    const size = map.clientWidth, [x, y] = chosen < 0 ? [size / 2, size / 2] : at(chosen, size);
    const ahead = (a, b, i) => i !== chosen && (a - x) * way[0] + (b - y) * way[1] > Math.abs((a - x) * way[1] + (b - y) * way[0]);
    choose(nearest(x, y, size, chosen < 0 ? () => true : ahead));
  });
  const recolour = guard(async () => {
    if (!column) { colours = { codes: points.rows.map(() => 0), names: ["features"] }; } else {
      colours = await json(`${source}/colours?method=${method}&column=${encodeURIComponent(column)}`);
    }
    if (colours.values) {
      const known = colours.values.filter((value) => value !== null);
      colours.low = known.reduce((a, b) => Math.min(a, b), Infinity);
      colours.high = known.reduce((a, b) => Math.max(a, b), -Infinity);
      names.replaceChildren(el("span", {}, `blue ${colours.low} to red ${colours.high}`));
    } else names.replaceChildren(...legend(colours.names));
    draw();
  });
  const load = guard(async () => {
    say(method === "tsne" ? "Computing the t-SNE. This takes up to a minute." : "");
    points = null;
    const loaded = await json(`${source}/map?method=${method}`);
    points = loaded;
    chosen = -1;
    const shown = points.rows.length < about.count ? `, ${points.rows.length.toLocaleString("en")} of them drawn` : "";
    say(`${about.count.toLocaleString("en")} features by ${about.from.encoder ?? "an unknown encoder"}${shown}`);
    await recolour();
  });
  others.addEventListener("change", () => choose(chosen));
  const bar = el("div", { className: "bar" },
    option("map", [["pca", "PCA"], ["tsne", "t-SNE"]], method, (value) => { method = value; load(); }),
    option("colour", about.columns.map((name) => [name, name.replace("label.", "")]), column, (value) => { column = value; recolour(); }),
    el("label", { className: "row" }, others, "neighbours of other sensors only"));
  side.append(el("p", { className: "soft" }, "Click a point, or move with the arrow keys on the map."));
  main.replaceChildren(bar, el("div", { className: "split" }, el("div", {}, map, names), side));
  keys([["m", "to the map", () => map.focus()], ["c", "colour", () => bar.querySelectorAll("select")[1].focus()]]);
  window.addEventListener("resize", draw);
  state.stop = () => { clearInterval(timer); window.removeEventListener("resize", draw); };
  load();
}

// ---- a run -------------------------------------------------------------------------------------------------------

function showRun(source) {
  const TERMS = ["loss", "reconstruction", "next_frame", "align", "match"];
  let next = 0, shown = "", lines = [], figures = [], failed = false, log = true;
  const canvas = el("canvas", { className: "chart tall", role: "img", ariaLabel: "losses by step" });
  const names = el("div", { className: "legend" }), facts = el("div", { className: "facts" }), wide = el("div", { className: "wide" });
  const pick = el("select", { onchange: () => figure(pick.value) });
  const draw = () => {
    const terms = TERMS.filter((term) => lines.some((line) => term in line));
    const curves = terms.map((name, i) => {
      const some = lines.filter((line) => name in line);
      return { name, x: some.map((line) => line.step), values: some.map((line) => line[name]), colour: COLOURS[i] };
    });
    chart(canvas, curves, { log });
    names.replaceChildren(...legend(terms));
    const last = lines[lines.length - 1] ?? {};
    facts.replaceChildren(...["step", ...TERMS, "seconds", "learning_rate"].filter((name) => name in last).map((name) =>
      el("div", { className: "fact" }, name.replace("_", " "), el("b", {}, Number(last[name].toPrecision(5)).toString()))));
  };
  const figure = guard(async (name) => {
    shown = name;
    wide.replaceChildren(await picture(`${source}/figure/${encodeURIComponent(name)}`, name));
  });
  const poll = async () => {
    try {
      const found = await json(`${source}/losses?after=${next}`);
      if (found.next < next) lines = [];
      next = found.next;
      if (found.lines.length || !lines.length) {
        lines = lines.concat(found.lines);
        if (lines.length > 6000) lines = lines.filter((_, i) => i % 2 === 0 || i > lines.length - 1000);
        draw();
      }
      if (found.figures[0] !== figures[0]) {
        const newest = !shown || shown === figures[0];
        figures = found.figures;
        pick.replaceChildren(...figures.map((name) => el("option", { value: name }, name)));
        if (newest) figure(figures[0]); else pick.value = shown;
      }
      say(lines.length ? "" : "This run has no step yet.");
      failed = false;
    } catch (error) { if (!failed) say(error.message, true); failed = true; }
  };
  main.replaceChildren(facts, el("div", { className: "bar" },
    option("scale", [["log", "logarithmic"], ["linear", "linear"]], "log", (value) => { log = value === "log"; draw(); }),
    el("label", {}, "figure: reconstructions, masks and predicted frames", pick)), canvas, names, wide);
  keys([["f", "figures", () => pick.focus()]]);
  window.addEventListener("resize", draw);
  const timer = setInterval(poll, 2000);
  state.stop = () => { clearInterval(timer); window.removeEventListener("resize", draw); };
  poll();
}

// ---- live --------------------------------------------------------------------------------------------------------

function showLive(source, about) {
  const panels = panelSet(), facts = el("div", { className: "facts" }), near = el("div", { className: "thumbs" });
  const canvas = el("canvas", { className: "chart", role: "img", ariaLabel: "contact score" });
  const pictures = about.table === null ? null : new Pictures(about.table, true), stopped = new AbortController();
  const ages = [], scores = [], boxes = {}, view = { rotate: 0, flip: "none" };
  let shownNear = "", recording = false;
  const fact = (name, value, kind = "") => {
    boxes[name] ??= facts.appendChild(el("div", { className: "fact" }, name, el("b")));
    if (boxes[name].lastChild.textContent !== value) boxes[name].lastChild.textContent = value;
    boxes[name].className = `fact ${kind}`;
  };
  const send = guard(async (body) => { say(""); await order(source, body); });
  const turn = () => send({ do: "orient", rotate: Number(view.rotate), flip: view.flip });
  const object = el("input", { placeholder: "name of the object", maxLength: 100 });
  const record = el("button", { disabled: !about.record, title: about.record ? "" : "Start again with --out FOLDER to record.",
    onclick: () => send(recording ? { do: "stop" } : { do: "record", object: object.value }) }, "Record");
  const background = el("button", { onclick: () => send({ do: "background" }) }, "Capture background");
  main.replaceChildren(
    el("div", { className: "bar" },
      option("rotate", [0, 90, 180, 270].map((angle) => [angle, `${angle}°`]), 0, (value) => { view.rotate = value; turn(); }),
      option("flip", [["none", "none"], ["across", "left-right"], ["down", "top-bottom"]], "none", (value) => { view.flip = value; turn(); }),
      background, el("button", { onclick: () => send({ do: "no background" }) }, "No background"),
      el("label", {}, "object", object), record),
    facts, panels.node, canvas, el("h2", { hidden: about.table === null }, "Nearest known touches"), near);
  keys([["b", "capture background", () => background.click()], ["r", "record or stop", () => record.click()]]);
  const percentile = (values, share) => [...values].sort((a, b) => a - b)[Math.floor(share * (values.length - 1))] ?? 0;
  const show = async (one, jpeg) => {
    if (one.error) { say(one.error, true); return; }
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    panels.draw({ bitmap, panels: one.panels });
    bitmap.close();
    const age = performance.timeOrigin + performance.now() - one.grabbed;
    ages.push(age);
    if (ages.length > 600) ages.shift();
    scores.push(one.score);
    if (scores.length > 300) scores.shift();
    main.dataset.frames = Number(main.dataset.frames ?? 0) + 1;
    if (one.frame % 10 && ages.length > 10) return; // text ten times as slow as pictures can be read
    main.dataset.ages = JSON.stringify([percentile(ages, 0.5), percentile(ages, 0.99), Math.max(...ages)].map(Math.round));
    canvas.hidden = scores.every((score) => score === null);
    if (!canvas.hidden) chart(canvas, [{ values: scores, colour: COLOURS[6] }], { level: one.threshold });
    fact("contact", one.contact === null ? "capture a background" : one.contact ? "contact" : "none", one.contact ? "good" : "");
    if (about.head) {
      fact(about.head, `${one.label} ${(100 * one.p).toFixed(0)} %`, one.novel || (one.set && one.set.length !== 1) ? "bad" : "good");
      if (one.set) fact("possible classes", one.set.slice(0, 4).join(", ") || "none");
      if (one.novelty !== undefined) fact("novelty", `${one.novelty} (limit ${one.limit ?? "unknown"})`, one.novel ? "bad" : "");
    }
    fact("encoder p50, p99", `${one.encoder.map((value) => value.toFixed(1)).join(", ")} ms`);
    fact("frame to features", `${one.age.map((value) => value.toFixed(1)).join(", ")} ms`);
    fact("age on this page", `${percentile(ages, 0.5).toFixed(0)}, ${percentile(ages, 0.99).toFixed(0)} ms`, percentile(ages, 0.99) > 100 ? "bad" : "");
    fact("picture", one.missed ? `${one.picture}, ${one.missed} missed` : one.picture, one.picture === "ok" ? "" : "bad");
    if (one.recording) {
      recording = one.recording.on;
      record.textContent = recording ? `Stop (${one.recording.written} frames)` : "Record";
      record.classList.toggle("on", recording);
      if (one.recording.done && !recording) fact("last recording", one.recording.done);
      if (one.recording.lost) fact("frames lost", String(one.recording.lost), "bad");
    }
    const rows = JSON.stringify(one.near.map((hit) => hit.row));
    if (rows !== shownNear) {
      shownNear = rows;
      near.replaceChildren(...one.near.map((hit) => hitCard(about, hit, pictures, guard(async () => {
        if (pictures) select(about.table, (await json(`${about.table}/touch?row=${hit.table_row}`)).place);
      }))));
    }
  };
  const read = guard(async () => {
    const reader = (await api(`${source}/stream`, { signal: stopped.signal })).body.getReader();
    let data = new Uint8Array(0);
    for (;;) {
      const { value, done } = await reader.read();
      if (done) { say("The stream has ended.", true); return; }
      const joined = new Uint8Array(data.length + value.length);
      joined.set(data);
      joined.set(value, data.length);
      data = joined;
      let newest = null;
      for (;;) { // only the newest whole packet is drawn
        const view = new DataView(data.buffer, data.byteOffset, data.length);
        const text = data.length >= 4 ? view.getUint32(0, true) : 0, end = data.length >= 8 + text ? view.getUint32(4 + text, true) : 0;
        if (data.length < 8 + text || data.length < 8 + text + end || data.length < 8) break;
        newest = [JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + text))), data.slice(8 + text, 8 + text + end)];
        data = data.slice(8 + text + end);
      }
      if (newest) await show(...newest);
    }
  });
  say(`${about.encoder}, sensor ${about.sensor ?? "universal tokens"}`);
  state.stop = () => stopped.abort();
  read();
}

// ---- start -------------------------------------------------------------------------------------------------------

function select(number, place = 0) {
  state.stop();
  const { kind, about } = state.sources[number], show = { table: showTable, space: showSpace, run: showRun, live: showLive };
  [...tabs.children].forEach((tab, i) => tab.setAttribute("aria-current", i === number));
  main.replaceChildren();
  for (const name of Object.keys(main.dataset)) delete main.dataset[name];
  say("");
  main.focus({ preventScroll: true }); // keys go to the page, and Space not to the tab
  show[kind](number, about, place);
}

async function start() {
  try {
    state.sources = await json("sources");
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
  const words = { table: "", space: "features: ", run: "run: ", live: "live: " };
  tabs.replaceChildren(...state.sources.map((one, i) => el("button", { onclick: () => select(i) }, words[one.kind] + one.name)));
  const live = state.sources.findIndex((one) => one.kind === "live");
  select(Math.max(0, live));
}
start();
