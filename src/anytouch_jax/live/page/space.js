"use strict";
// The map of features, and the losses of a run.

// ---- features ----------------------------------------------------------------------------------------------------

function hitCard(hit, images, open) {
  const text = [hit.about.object, hit.about.sensor, hit.cosine?.toFixed(3)].filter((part) => part).join(", ");
  const all = Object.entries(hit.about).map((pair) => pair.join(": ")).join("\n");
  return thumbnail(images, hit.table_row, text, open, all);
}

function showSpace(source, about) {
  let points = null, colours = null, chosen = -1, method = "pca", timer = null, marked = [];
  let column = ["object", "sensor"].find((name) => about.columns.includes(name)) ?? about.columns[0] ?? "";
  const images = about.table === null ? null : framesOf(about.table, "frame");
  const names = el("div", { className: "legend small" }), side = el("div", { className: "column" });
  const others = el("input", { type: "checkbox", checked: about.sensors > 1 });
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
    const list = el("dl", { className: "small" });
    for (const [name, value] of Object.entries(found.row.about)) {
      const short = name.replace("label.", "");
      if (short === name || value !== found.row.about[short]) list.append(el("div", {}, el("dt", {}, short), el("dd", {}, /^-?\d+\.\d{4,}$/.test(value) ? Number(value).toPrecision(3) : value)));
    }
    clearInterval(timer);
    const parts = [];
    if (images) {
      const canvas = el("canvas", { role: "img", ariaLabel: "the chosen touch" }), touch = await json(`${about.table}/touch?row=${found.row.table_row}`);
      const clip = touch.clips.find((each) => each.rows.includes(found.row.table_row)) ?? touch.clips[0];
      let t = clip.rows.indexOf(found.row.table_row);
      const draw = (row) => { const one = images.get(row); if (one.bitmap) paint(canvas, one.bitmap); return one; };
      draw(found.row.table_row).wait.then(() => draw(found.row.table_row));
      timer = setInterval(() => {
        if (!draw(clip.rows[(t = (t + 1) % clip.rows.length)]).ready) t--;
      }, 2000 / RATE);
      parts.push(el("div", { className: "stage" }, canvas), el("button", { onclick: open(found.row) }, "Show this touch"));
    } else {
      parts.push(el("p", { className: "soft" }, "Name the manifest too, and you see the images."));
    }
    const cards = found.hits.map((hit) => hitCard(hit, images, images ? open(hit) : () => choose(points.rows.indexOf(hit.row))));
    side.replaceChildren(el("h3", {}, found.row.about.object || `Row ${found.row.row}`), list, ...parts,
      el("h3", {}, `${cards.length} nearest, of ${others.checked ? "other sensors" : "other recordings"}`),
      el("div", { className: "thumbs" }, ...cards));
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
    say(method === "tsne" ? "Computing the t-SNE. This takes up to a minute." : "Reading the features.");
    points = null;
    const loaded = await json(`${source}/map?method=${method}`);
    points = loaded;
    chosen = -1;
    const shown = points.rows.length < about.count ? `, ${points.rows.length.toLocaleString("en")} of them drawn` : "";
    say(`${about.count.toLocaleString("en")} features by ${about.from.encoder ?? "an unknown encoder"}${shown}`);
    await recolour();
    choose(nearest(map.clientWidth / 2, map.clientWidth / 2, map.clientWidth));
  });
  others.addEventListener("change", () => choose(chosen));
  const bar = el("div", { className: "bar" },
    option("map", [["pca", "PCA"], ["tsne", "t-SNE"]], method, (value) => { method = value; load(); }),
    option("colour", about.columns.map((name) => [name, name.replace("label.", "")]), column, (value) => { column = value; recolour(); }),
    el("label", { hidden: about.sensors < 2 }, others, "neighbours of other sensors only"));
  const hint = el("p", { className: "soft small" }, "Click a point, or move with the arrow keys on the map.");
  main.replaceChildren(el("h2", {}, state.sources[source].name), bar, el("div", { className: "split" }, el("div", { className: "column" }, map, hint, names), side));
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
  const names = el("div", { className: "legend small" }), facts = el("div", { className: "facts" }), wide = el("div", { className: "wide" });
  const pick = el("select", { onchange: () => figure(pick.value) });
  const figureLabel = el("label", { hidden: true }, "figure: reconstructions, masks and predicted frames", pick);
  // Of stills the loss is the reconstruction, and one line is enough.
  const isAgain = (term) => term === "reconstruction" && lines.every((line) => !(term in line) || Math.abs(line[term] - line.loss) < 1e-9 * Math.abs(line.loss));
  // A mean that forgets: over a fiftieth of the steps, or a few, so that what moves can be seen through the noise.
  const shortNumber = (value) => (value && Math.abs(value) < 1e-3 ? value.toExponential(1) : Number(value.toPrecision(5)).toString());
  const smooth = (values) => {
    const keep = Math.exp(-50 / Math.max(values.length, 250));
    let mean = values[0];
    return values.map((value) => (mean = keep * mean + (1 - keep) * value));
  };
  const draw = () => {
    const terms = TERMS.filter((term) => lines.some((line) => term in line) && !isAgain(term));
    const curves = terms.flatMap((name, i) => {
      const some = lines.filter((line) => name in line), x = some.map((line) => line.step), values = some.map((line) => line[name]);
      return [{ x, values, ...looks(i), faint: true, dash: [] }, { x, values: smooth(values), ...looks(i) }];
    });
    const untrained = lines[0]?.[terms[0]] ?? null;
    chart(canvas, curves, { log, level: untrained });
    names.replaceChildren(...legend(terms.map((term) => term.replace("_", " ")), true), ...(untrained === null ? [] : [el("span", {}, swatch(getComputedStyle(document.body).getPropertyValue("--soft"), [4, 4]),
      `baseline: ${terms[0]} at the first step, ${Number(untrained.toPrecision(3))}`)]), el("span", {}, "faint: every step, firm: smoothed"));
    const last = lines[lines.length - 1] ?? {};
    facts.replaceChildren(...["step", ...TERMS, "seconds", "learning_rate"].filter((name) => name in last).map((name) =>
      el("div", { className: "fact" }, name.replace("_", " "), el("b", {}, shortNumber(last[name])))));
  };
  const figure = guard(async (name) => {
    shown = name;
    wide.replaceChildren(await imageOf(`${source}/figure/${encodeURIComponent(name)}`, name));
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
        figureLabel.hidden = !figures.length;
        pick.replaceChildren(...figures.map((name) => el("option", { value: name }, name)));
        if (newest) figure(figures[0]); else pick.value = shown;
      }
      say(lines.length ? "" : "This run has no step yet.");
      failed = false;
    } catch (error) { if (!failed) say(error.message, true); failed = true; }
  };
  main.replaceChildren(el("h2", {}, state.sources[source].name), facts, el("div", { className: "bar" },
    option("scale", [["log", "logarithmic"], ["linear", "linear"]], "log", (value) => { log = value === "log"; draw(); }),
    figureLabel), canvas, names, wide);
  keys([["f", "figures", () => pick.focus()]]);
  window.addEventListener("resize", draw);
  const timer = setInterval(poll, 2000);
  state.stop = () => { clearInterval(timer); window.removeEventListener("resize", draw); };
  poll();
}
