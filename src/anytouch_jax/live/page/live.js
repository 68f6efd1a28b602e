"use strict";
// Live touch, and a classifier that is taught by touching.

const KEPT_LIVE = 300, HELD = 400; // points of a live curve, ms from which a pressed button was held
const KEPT_AGES = 600; // frames whose ages make p50 and p99
const CURVES = 100, WORDS = 300; // ms between drawings of the curves, and between changes of words, which people read

const percent = (fraction) => `${Math.round(100 * fraction)} %`;

// How good the head is, in words and as bars.
function verdict(result, isMeasured) {
  if (!isMeasured) return [el("p", { className: "soft" }, "It names already. How good it is on recordings that are left out is being measured.")];
  if (result.right === undefined) return [el("p", { className: "soft" }, "Record each name twice or more. Then the page measures how good the head is.")];
  const range = (name) => (result[`${name}_low`] < result[`${name}_high`] ? ` (${Math.round(100 * result[`${name}_low`])} to ${Math.round(100 * result[`${name}_high`])})` : "");
  const bar = (name, fraction, own, note) => {
    const inner = el("i", { className: own ? "ours" : "" });
    inner.style.width = `${100 * fraction}%`;
    return [el("span", {}, name), el("span", { className: "track" }, inner), el("span", {}, percent(fraction) + note)];
  };
  const better = result.right > result.pixels;
  const useless = result.right > result.chance ? "" : " That is no better than the commonest name alone: record each name again.";
  return [el("p", {}, `Right on ${percent(result.right)} of frames of recordings that were left out. ${better
    ? `Raw pixels reach ${percent(result.pixels)}.` : `Raw pixels reach ${percent(result.pixels)}, so the encoder adds nothing here.`}${useless}`),
  el("div", { className: "bars small" }, ...bar("this head", result.right, true, range("right")),
    ...bar("raw pixels", result.pixels, false, range("pixels")), ...bar("commonest name", result.chance, false, "")),
  ...(result.once ? [el("p", { className: "soft small" }, `${result.once} names were recorded once only. They do not count here: record them again.`)] : [])];
}

function showLive(source, about) {
  const canvas = el("canvas", { role: "img", ariaLabel: "live image" }), curves = el("section", { className: "time" });
  const felt = el("h2", { className: "felt" }), sure = el("div", { className: "bars small" }), why = el("p", { className: "soft" });
  const facts = el("div", { className: "facts" }), near = el("div", { className: "thumbs" }), nearest = el("div", { className: "thumbs" });
  const force = forceBar(), images = about.table === null ? null : framesOf(about.table, "frame", true);
  const ages = [], parts = [], scores = {}, rows = {}, boxes = {}, view = { rotate: 0, flip: "none" };
  let drawnAt = 0, toldAt = 0, stopped = new AbortController(), shownNear = "", done = null, recording = false, asked = "", pressed = 0, taught = -1, learning = false, listed = "", trained = false, orders = Promise.resolve();
  let recorded = new Images(`${source}/recorded`, "frame", true);
  const fact = (name, value, kind = "") => {
    boxes[name] ??= facts.appendChild(el("div", { className: "fact" }, name, el("b")));
    if (boxes[name].lastChild.textContent !== value) boxes[name].lastChild.textContent = value;
    boxes[name].className = `fact ${kind}`;
  };
  // Orders go one after the other: a recording begins before it ends.
  const send = (body, more) => (orders = orders.then(() => { say(""); return order(source, body, more); }).catch((error) => { say(error.message, true); }));
  const turn = () => send({ do: "orient", rotate: Number(view.rotate), flip: view.flip });

  // Teach: hold the button to record, or press it shortly to record until the next press.
  const known = el("datalist", { id: "known-names" });
  const object = el("input", { list: known.id, maxLength: 100, autocomplete: "off", placeholder: "cup" });
  const record = el("button", { className: "main record" }, "Hold to record");
  // Frames that are under way still tell of the recording before. Until one shows what was ordered, the order counts.
  const isOn = () => (asked ? asked === "record" : recording);
  const direct = (body) => { asked = body.do; send(body).then((done) => { if (!done) asked = ""; }); };
  const begin = () => {
    if (isOn() || pressed) { end(); return; }
    pressed = performance.now();
    direct({ do: "record", object: object.value });
  };
  const end = () => { pressed = 0; direct({ do: "stop" }); };
  const release = () => { if (pressed && performance.now() - pressed > HELD) end(); else pressed = 0; };
  const hold = (event) => [" ", "Enter"].includes(event.key) && (event.preventDefault(), true);
  record.addEventListener("pointerdown", (event) => { if (event.button === 0) { record.setPointerCapture(event.pointerId); begin(); } });
  record.addEventListener("pointerup", release);
  record.addEventListener("pointercancel", release);
  record.addEventListener("contextmenu", (event) => event.preventDefault());
  record.addEventListener("keydown", (event) => { if (hold(event) && !event.repeat) begin(); });
  record.addEventListener("keyup", (event) => { if (hold(event)) release(); });
  record.addEventListener("click", (event) => { if (event.detail === 0 && !event.pointerType) begin(); }); // by a screen reader
  const lifted = (event) => { if (event.key === "r") release(); };
  const leave = () => { if (pressed) send({ do: "stop" }, { keepalive: true }); };
  const names = el("ul", { className: "names" }), train = el("button", { onclick: () => send({ do: "train" }) }, "Train");
  const longer = el("button", { onclick: () => send({ do: longer.dataset.on ? "keep the best" : "train longer" }), hidden: true }, "Train longer");
  const course = el("p", { className: "soft", role: "status" });
  const missing = el("p", { className: "soft", role: "status" }), result = el("div", { className: "column" });
  const save = (file) => guard(async () => {
    const address = URL.createObjectURL(await (await api(`${source}/taught/${file}`)).blob());
    el("a", { href: address, download: file }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  });
  const downloads = el("div", { className: "bar" }, el("button", { onclick: save("head.npz") }, "Download head"),
    el("button", { onclick: save("recordings.zip") }, "Download recordings"));
  const listNames = (several) => {
    recorded = new Images(`${source}/recorded`, "frame", true);
    known.replaceChildren(...several.map(([name]) => el("option", { value: name })));
    names.replaceChildren(...several.map(([name, one]) => {
      const count = `${one.recordings} ${one.recordings === 1 ? "recording" : "recordings"}`;
      return el("li", {}, recorded.image(one.row, `a touch of ${name}`), el("span", {}, el("b", {}, name), el("span", { className: "soft small" }, count)),
        el("button", { className: "quiet small", title: "Its frames stay on the disk.", ariaLabel: `Leave out last recording of ${name}`,
          onclick: () => send({ do: "leave out", sequence: one.last }) }, "Leave out last"));
    }));
  };
  const learn = async () => {
    const found = await json(`${source}/taught`), several = Object.entries(found.names);
    trained = found.trained;
    // The list stays while it is the same: a button that is replaced under a finger cannot be pressed.
    if (listed !== JSON.stringify(several)) { listed = JSON.stringify(several); listNames(several); }
    train.disabled = found.training || Boolean(found.missing);
    train.className = several.length > 1 && !found.trained ? "main" : "";
    train.textContent = found.training ? (found.trained && found.result.right === undefined ? "Measuring …" : "Training …") : found.trained ? "Train again" : "Train";
    const more = found.longer, clock = (left) => `${Math.floor(left / 60)}:${String(Math.floor(left % 60)).padStart(2, "0")}`;
    trained ||= more.used;
    longer.hidden = !found.trained && !more.on;
    longer.dataset.on = more.on ? "on" : "";
    longer.textContent = more.on ? "Stop and keep the best" : "Train longer";
    longer.title = "Trains the encoder too, on all recordings. Some are held out, and it never ends below the head.";
    train.disabled ||= more.on;
    course.className = more.fault ? "alarm" : "soft";
    course.ariaLive = more.on ? "off" : "polite"; // a screen reader would read each second
    course.textContent = more.on ? `Training the encoder: ${clock(more.left)} left${more.score ? `. On held-out recordings: ${more.score}, the head alone: ${more.before}.` : ""}` : more.fault || more.said;
    missing.className = found.fault ? "alarm" : "soft";
    missing.textContent = found.fault || (several.length ? found.missing : "Type a name, hold the button, and touch. Touch it again for a second recording. Then teach another name.");
    downloads.hidden = !several.length;
    downloads.firstChild.disabled = !found.trained;
    const by = more.used ? `--model ${more.folder}` : `--head ${found.file}`;
    const use = `anytouch stream --data ${/^\d+$/.test(about.source) ? about.source : "0"} ${about.sensor ? `--sensor ${about.sensor} ` : ""}${by} --out -`;
    result.replaceChildren(...(found.trained ? [...verdict(found.result, !found.training || found.result.right !== undefined), el("p", { className: "soft small" }, "Use it in a robot:"), command(use)] : []));
  };
  // One question at a time: on a busy machine, an answer could come after that of a later question and stay.
  const learnOnce = guard(async (version) => {
    if (learning) return;
    learning = true;
    try {
      await learn();
      taught = version;
    } catch (error) {
      await new Promise((go) => setTimeout(go, 1000)); // then the next frame asks again
      throw error;
    } finally { learning = false; }
  });

  const curve = (name, value, level) => {
    if (!scores[name]) {
      scores[name] = [];
      rows[name] = curveRow(name);
      curves.append(...rows[name].parts);
    }
    scores[name].push(value);
    if (scores[name].length > KEPT_LIVE) scores[name].shift();
    return () => {
      rows[name].draw([{ values: scores[name], colour: accent() }], { level, reach: REACH[name], length: KEPT_LIVE });
      rows[name].now.textContent = shortened(value, unitOf(name));
    };
  };
  // What is not known of a frame, such as slip where nothing touches, is a gap in its curve.
  const curvesOf = (one) => {
    const { contact, ...others } = one.curves, found = Object.fromEntries(Object.keys(scores).map((name) => [name, null]));
    if (contact !== undefined) found[CONTACT] = inPercent(contact);
    return { ...found, ...others };
  };
  const feel = (one) => {
    const known = about.head || trained;
    feels.hidden = !known && one.contact === null;
    const named = known && one.contact !== false && one.label !== undefined;
    feels.classList.toggle("novel", Boolean(named && one.novel));
    sure.hidden = !named || one.novel || one.p === undefined;
    nearest.hidden = !named;
    why.textContent = "";
    if (!known && one.contact === null) { felt.textContent = ""; return; }
    if (!known || one.contact === false) { felt.textContent = one.contact ? "● Contact" : "○ No contact"; return; }
    if (one.label === undefined) return;
    fact("novelty", one.novelty === undefined ? "unknown" : `${one.novelty}${one.limit ? ` (limit ${one.limit})` : ""}`, one.novel ? "bad" : "");
    fact("possible names", one.set ? one.set.slice(0, 4).join(", ") || "none" : "unknown");
    // Something new is a state of its own. A bar would say how sure the head is of a name that it does not have.
    if (one.novel) {
      felt.textContent = "Something new";
      why.textContent = `Unlike every recording. The nearest name is ${one.recorded?.[0]?.about.object ?? one.label}.`;
      return;
    }
    felt.textContent = one.label;
    const bar = el("i", { className: "ours" });
    bar.style.width = `${100 * one.p}%`;
    sure.replaceChildren(el("span", {}, "probability"), el("span", { className: "track" }, bar), el("span", {}, percent(one.p)));
    if (one.set === undefined) return;
    if (one.limit === null) why.textContent = `From ${one.recordings} recordings it cannot tell what is new. Record more: nine can.`;
    else if (!one.set.length) why.textContent = "Unsure: recordings of it were named with more certainty.";
    else if (one.set.length > 1) why.textContent = `It may be ${one.set.slice(0, 4).join(", ")}.`;
  };
  const percentile = (values, fraction) => [...values].sort((a, b) => a - b)[Math.floor(fraction * (values.length - 1))] ?? 0;
  const show = async (one, jpeg, arrived) => {
    if (one.error) { say(one.error, true); return; }
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    showLayer(canvas, bitmap, one.layer === "surface" ? one.fields : null);
    bitmap.close();
    const drawn = performance.timeOrigin + performance.now();
    ages.push(drawn - one.grabbed);
    parts.push([one.sent - one.grabbed, arrived - one.sent, drawn - arrived]); // to its packet, to the page, to the canvas
    for (const list of [ages, parts]) if (list.length > KEPT_AGES) list.shift();
    const draws = Object.entries(curvesOf(one)).map(([name, value]) => curve(name, value, name === CONTACT ? inPercent(one.threshold) : null));
    main.dataset.frames = Number(main.dataset.frames ?? 0) + 1;
    if (one.taught !== taught) learnOnce(one.taught);
    recording = one.recording.on;
    if (asked && recording === (asked === "record")) asked = "";
    const now = performance.now();
    if (now - drawnAt > CURVES) {
      drawnAt = now;
      draws.forEach((draw) => draw());
    }
    if (now - toldAt < WORDS) return;
    toldAt = now;
    main.dataset.ages = JSON.stringify([percentile(ages, 0.5), percentile(ages, 0.99), Math.max(...ages)].map(Math.round));
    main.dataset.parts = JSON.stringify([0, 1, 2].map((i) => Number(percentile(parts.map((each) => each[i]), 0.5).toFixed(1))));
    feel(one);
    force.show(one.fields, one.layer, one.note);
    hidden.hidden = one.layer === state.layer;
    hidden.textContent = one.note ? `${one.note} Nothing is measured, so the image is shown.` : "The untouched gel is not known yet, so the image is shown.";
    record.textContent = recording ? `Recording ${one.recording.name}: ${one.recording.written} frames` : "Hold to record";
    record.classList.toggle("on", recording);
    const lost = one.recording.lost ? ` ${one.recording.lost} frames were lost, since the disk is slow.` : "";
    if (recording) done = one.recording.done;
    else if (done === null) done = one.recording.done; // what was recorded before this page
    else if (one.recording.done !== done) { done = one.recording.done; say(done + lost, !/^\d/.test(done)); }
    fact("untouched gel", one.gel);
    fact("encoder p50, p99", `${one.encoder.map((value) => value.toFixed(1)).join(", ")} ms`);
    fact("frame to features", `${one.age.map((value) => value.toFixed(1)).join(", ")} ms`);
    fact("age on this page", `${percentile(ages, 0.5).toFixed(0)}, ${percentile(ages, 0.99).toFixed(0)} ms`, percentile(ages, 0.99) > 100 ? "bad" : "");
    if (one.picture !== "ok" || one.missed) say(`The image is ${one.picture}, ${one.missed} reads were missed.`, one.picture !== "ok");
    const hits = JSON.stringify([one.near, one.recorded].map((found) => found?.map((hit) => hit.row)));
    if (hits === shownNear) return;
    shownNear = hits;
    near.replaceChildren(...(one.near ?? []).map((hit) => hitCard(hit, images, guard(async () => {
      if (images) select(about.table, (await json(`${about.table}/touch?row=${hit.table_row}`)).place);
    }))));
    nearest.replaceChildren(...(one.recorded ?? []).slice(0, 2).map((hit) =>
      el("figure", {}, recorded.image(hit.table_row, `recorded touch of ${hit.about.object}`), el("figcaption", {}, `${hit.about.object}, alike ${hit.cosine.toFixed(2)}`))));
  };
  const read = guard(async () => {
    stopped.abort();
    stopped = new AbortController();
    // An image has no more pixels than are shown: the browser decodes each of them.
    const side = Math.round((window.devicePixelRatio || 1) * Math.max(canvas.clientWidth, canvas.clientHeight)) || 640;
    const reader = (await api(`${source}/stream?layer=${state.layer}&side=${side}`, { signal: stopped.signal })).body.getReader();
    let data = new Uint8Array(0), newest = null, drawing = false;
    const draw = guard(async () => { // while one is decoded, others arrive: only the newest is drawn next
      drawing = true;
      try {
        while (newest) { const next = newest; newest = null; await show(...next); }
      } finally { drawing = false; }
    });
    for (;;) {
      const { value, done } = await reader.read();
      if (done) { say("The stream has ended. Start `anytouch view` again.", true); return; }
      const joined = new Uint8Array(data.length + value.length);
      joined.set(data);
      joined.set(value, data.length);
      data = joined;
      for (;;) {
        const view = new DataView(data.buffer, data.byteOffset, data.length);
        const text = data.length >= 4 ? view.getUint32(0, true) : 0, end = data.length >= 8 + text ? view.getUint32(4 + text, true) : 0;
        if (data.length < 8 + text || data.length < 8 + text + end || data.length < 8) break;
        newest = [JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + text))), data.slice(8 + text, 8 + text + end), performance.timeOrigin + performance.now()];
        data = data.slice(8 + text + end);
      }
      if (newest && !drawing) draw();
    }
  });

  const layers = layerBar(about.layers, read);
  const hidden = el("span", { className: "soft", hidden: true });
  const background = el("button", { onclick: () => send({ do: "background" }) }, "Capture the untouched gel");
  const feels = el("section", { className: "card feels", hidden: true }, felt, sure, why, nearest);
  // On a phone this bar stays at the bottom, under the thumb.
  const recordBar = el("div", { className: "recordbar" }, el("label", { className: "tall" }, "name of what you touch", object), record);
  const teach = el("section", { className: "card teach" }, el("h3", {}, "Teach it a touch"), known, recordBar, names, missing, el("div", { className: "bar" }, train, longer), course, result, downloads);
  const more = el("details", {}, el("summary", {}, "Camera and latency"), el("div", { className: "column" }, el("div", { className: "bar" },
    option("rotate", [0, 90, 180, 270].map((angle) => [angle, `${angle}°`]), 0, (value) => { view.rotate = value; turn(); }),
    option("flip", [["none", "none"], ["across", "left-right"], ["down", "top-bottom"]], "none", (value) => { view.flip = value; turn(); }),
    background, el("button", { onclick: () => send({ do: "no background" }) }, "Estimate it again")), facts));
  const look = el("div", { className: "look" }, el("div", { className: "column" }, stage(canvas), hidden), el("div", { className: "column" }, force.node, curves));
  main.replaceChildren(el("div", { className: "split live" }, feels,
    el("div", { className: "column shown" }, el("div", { className: "bar" }, el("h2", {}, state.sources[source].name), el("div", { className: "push" }, layers.node)),
      look, el("h3", { hidden: about.table === null }, "Nearest known touches"), near),
    teach), more);
  keys([["r", "hold to record", () => { if (!state.repeated) begin(); }], ["l", "next layer", layers.next], ["b", "capture the untouched gel", () => background.click()]]);
  document.addEventListener("keyup", lifted);
  window.addEventListener("pagehide", leave);
  window.addEventListener("blur", release);
  fact("encoder", `${about.encoder}, ${about.sensor ?? "universal tokens"}`);
  state.stop = () => {
    leave();
    stopped.abort();
    document.removeEventListener("keyup", lifted);
    window.removeEventListener("pagehide", leave);
    window.removeEventListener("blur", release);
  };
  read();
}
