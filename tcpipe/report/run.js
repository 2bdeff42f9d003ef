"use strict";
// A run's page: its map and its plots over time under one cursor, and what is chosen, in words.
const packed = [page.data.spans, page.data.segments, ...Object.values(page.data.series).map((one) => one.packed)];
const unpacked = Promise.all(packed.map(page.unpack));
page.start(async () => {
  const { at, make, fillSelect, pairs, model, ramp } = page;
  const facts = page.data;
  const [spans, s, ...columns] = await unpacked;
  const series = Object.fromEntries(Object.entries(facts.series).map(([name, { gap_s }], i) => [name, { ...columns[i], gap_s }]));
  const [track, n] = [series.track, s.start.length];
  const panels = [];
  const range = model("gates").x_range;
  const names = { w: ["power w", "power", "W", 1], v: ["velocity v", "velocity", "m/s", 4], T: ["time T", "duration", "s", 4], E: ["energy E", "energy", "J", 1],
    slope: ["slope by the track", "slope", "°", 1], turn: ["turn", "turn", "°", 3], sigma: ["σ of position", "position_std", "m", 3],
    slip: ["slip", "slip", "", 3], vibration: ["vibration", "vibration", "m/s²", 2] };
  const ofTrack = { w: "power", v: "speed", sigma: "position_std" };  // columns that colour the whole track, segments or not
  const there = Object.keys(names).filter((key) => s[names[key][1]]?.some(Number.isFinite));
  const finite = Number.isFinite;

  // Where a time lies in a column of rising times.
  function after(times, t) {
    let [low, high] = [0, times.length];
    while (low < high) { const middle = (low + high) >> 1; if (times[middle] < t) low = middle + 1; else high = middle; }
    return low;
  }
  function nearest(times, t) {
    const i = after(times, t);
    return i > 0 && (i === times.length || t - times[i - 1] < times[i] - t) ? i - 1 : i;
  }

  // Every line as it looks at this zoom: of what shares a pixel the lowest and the highest.
  function seen(one, column, pixels) {
    const first = Math.max(0, after(one.t, range.start) - 1), last = Math.min(one.t.length, after(one.t, range.end) + 1);
    const per = Math.max(1, Math.floor((last - first) / (2 * pixels)));
    const [t, y] = [[], []];
    const push = (i) => {
      if (t.length && one.t[i] - t[t.length - 1] > Math.max(one.gap_s, 0)) { t.push(one.t[i]); y.push(NaN); }
      t.push(one.t[i]); y.push(column[i]);
    };
    for (let i = first; i < last; i += per) {
      if (per === 1) { push(i); continue; }
      let [low, high] = [-1, -1];
      for (let k = i; k < Math.min(i + per, last); k++) {
        if (!finite(column[k])) continue;
        if (low < 0 || column[k] < column[low]) low = k;
        if (high < 0 || column[k] > column[high]) high = k;
      }
      if (low < 0) push(i);
      else { push(Math.min(low, high)); if (low !== high) push(Math.max(low, high)); }
    }
    return { t, y };
  }
  // Bars and shades of what is not used; those that would share a pixel are one.
  function gates(pixels) {
    const pixel = (range.end - range.start) / pixels;
    const [bars, shade] = [{ left: [], right: [], row: [], colour: [] }, { x0: [], x1: [], colour: [] }];
    const open = new Map();
    const close = ([left, right, row, colour]) => { bars.left.push(left); bars.right.push(right); bars.row.push(row); bars.colour.push(colour); };
    const add = (row, colour, left, right) => {
      const before = open.get(row);
      if (before && left - before[1] < pixel) { before[1] = right; return; }
      if (before) close(before);
      open.set(row, [left, right, row, colour]);
    };
    for (let i = 0; i < spans.start.length; i++) {
      if (spans.end[i] < range.start || spans.start[i] > range.end) continue;
      const mine = facts.reasons.filter(([bit]) => spans.bits[i] & bit);
      if (!mine.length) add("kept", facts.kept, spans.start[i], spans.end[i]);
      mine.forEach(([, name, , colour]) => add(name, colour, spans.start[i], spans.end[i]));
      if (!mine.length) continue;
      const k = shade.x1.length - 1;
      if (k >= 0 && spans.start[i] - shade.x1[k] < pixel / 2 && (shade.colour[k] === mine[0][3] || spans.end[i] - spans.start[i] < pixel)) shade.x1[k] = spans.end[i];
      else { shade.x0.push(spans.start[i]); shade.x1.push(spans.end[i]); shade.colour.push(mine[0][3]); }
    }
    for (const left of open.values()) close(left);
    return [bars, shade];
  }
  function redraw(views = panels) {
    const pixels = Math.max(200, model("gates").inner_width || 800);
    const heights = new Map(), shown = new Set(views.map((view) => view.model.name));
    facts.lines.forEach((line, k) => {
      if (!shown.has(line.plot)) return;
      const data = seen(series[line.series], series[line.series][line.column], pixels);
      model(`line ${k}`).data_source.data = data;
      heights.set(line.plot, [...(heights.get(line.plot) ?? []), data.y.filter(finite)]);
    });
    for (const [plot, parts] of heights) {
      const known = Float64Array.from(parts.flat()).sort(), cut = at("peaks").checked ? 0 : 0.01;
      if (!known.length) continue;
      const low = known[Math.floor(cut * (known.length - 1))], high = known[Math.ceil((1 - cut) * (known.length - 1))], room = 0.06 * (high - low) || 1;
      model(plot).y_range.setv({ start: low - room, end: high + room });
    }
    const [bars, shade] = gates(pixels);
    if (shown.has("gates")) model("gates bars").data_source.data = bars;
    for (const view of views) model(`shade ${view.model.name}`).data_source.data = shade;
  }
  let waiting = 0;
  const soon = () => { clearTimeout(waiting); waiting = setTimeout(() => redraw(), 60); };
  range.properties.start.change.connect(soon);
  range.properties.end.change.connect(soon);

  const [first, last] = [facts.first_s, facts.last_s];
  const zoom = (start, end) => {
    const span = Math.min(end - start, last - first);
    const from = Math.min(Math.max(start, first), last - span);
    range.setv({ start: from, end: from + span });
  };
  const about = (share, shift) => {
    const span = range.end - range.start, middle = (range.start + range.end) / 2;
    zoom(middle - (span * share) / 2 + shift * span, middle + (span * share) / 2 + shift * span);
  };
  at("peaks").onchange = () => redraw();
  at("whole").onclick = () => zoom(first, last);
  at("in").onclick = () => about(0.5, 0);
  at("out").onclick = () => about(2, 0);
  at("back").onclick = () => about(1, -0.5);
  at("on").onclick = () => about(1, 0.5);

  // Segments on the map and in their own plot.
  const flagged = Array.from(s.quality, (bits) => (bits & facts.flags ? facts.doubted : facts.kept));
  function ramped(values, kind) {
    const [low, high] = page.ends(values);
    at("scale").replaceChildren(...page.scale(...[low, high].map((end) => page.quantity(end, ...kind.slice(2)))));
    return Array.from(values, (value) => finite(value)
      ? ramp[Math.max(0, Math.min(ramp.length - 1, Math.floor((ramp.length * (value - low)) / ((high - low) || 1))))] : facts.unused);
  }
  // The track from one time to another as lines, which gaps end.
  function pathOf(from, to) {
    const paths = [];
    let x = [], y = [];
    for (let k = from; k < to; k++) {
      const gap = k > from && track.t[k] - track.t[k - 1] > track.gap_s;
      if (gap || k === from) { x = []; y = []; paths.push([x, y]); }
      else if (k < to - 1 && Math.hypot(track.x[k] - x[x.length - 1], track.y[k] - y[y.length - 1]) < facts.step_m) continue;
      x.push(track.x[k]); y.push(track.y[k]);
    }
    return paths;
  }
  const lines = (paths, colour) => ({ xs: paths.map(([x]) => x), ys: paths.map(([, y]) => y), colour });
  const bySpan = [[], []];
  spans.start.forEach((start, i) => {
    for (const path of pathOf(after(track.t, start), Math.min(after(track.t, spans.end[i]) + 1, track.t.length))) {
      bySpan[0].push(path);
      bySpan[1].push(facts.reasons.find(([bit]) => spans.bits[i] & bit)?.[3] ?? facts.unused);
    }
  });
  function byColumn(key) {
    const step = Math.max(1, Math.ceil(track.t.length / 1500)), values = [], paths = [];
    for (let k = 0; k + 1 < track.t.length; k += step) {
      const known = Array.from(track[ofTrack[key]].slice(k, k + step)).filter(finite);
      for (const path of pathOf(k, Math.min(k + step + 1, track.t.length))) {
        paths.push(path);
        values.push(known.length ? page.mean(known) : NaN);
      }
    }
    return lines(paths, ramped(values, names[key]));
  }
  function paint() {
    const key = at("colour").value, whole = track[ofTrack[key]]?.some(finite);
    model("track").data_source.data = whole ? byColumn(key) : lines(...bySpan);
    model("track").glyph.line_width = { value: whole ? 6 : 3 };
    let colour = flagged;
    if (key === "severity") {
      const seen = facts.severities.filter((_, k) => s.severity.includes(k));
      at("scale").replaceChildren(...page.legend([...seen, ["no finding of its own", facts.kept], ["not in a segment", facts.unused]]));
      colour = Array.from(s.severity, (k) => facts.severities[k]?.[1] ?? facts.kept);
    } else if (key === "quality") {
      const entries = [["segment", facts.kept], ["with a flag", facts.doubted], ["kept, not in a segment", facts.unused], ...facts.reasons
        .filter(([bit]) => spans.bits.some((bits) => bits & bit)).map(([, name, , colour]) => [name, colour])];
      at("scale").replaceChildren(...page.legend(entries));
    } else if (!whole) colour = ramped(s[names[key][1]], names[key]);
    model("segments").data_source.data = whole ? { x0: [], y0: [], x1: [], y1: [], colour: [] } : { x0: s.x0, y0: s.y0, x1: s.x1, y1: s.y1, colour };
  }
  function label() {
    if (!model("labels")) return;
    const [, name, unit] = names[at("label").value];
    const y = Float64Array.from(s[name]), std = s[`${name}_std`];
    const off = (sign) => y.map((value, i) => value + sign * (std && finite(std[i]) ? std[i] : 0));
    model("labels").data_source.data = { t: s.start.map((t, i) => (t + s.end[i]) / 2), y, low: off(-1), high: off(1), colour: flagged };
    model("label plot").left[0].axis_label = `${at("label").value}${unit && ` [${unit}]`}${std ? ", ± σ" : ""}`;
  }
  const local = facts.findings.filter(([start, end]) => end - start < 0.9 * (facts.last_s - facts.first_s));  // others hold everywhere
  const found = local.flatMap(([start, end, colour]) => pathOf(after(track.t, start - 1), after(track.t, end + 1)).map((path) => [path, colour]));
  model("findings").data_source.data = lines(found.map(([path]) => path), found.map(([, colour]) => colour));
  page.chooseGround(facts.ground);
  at("ground").closest("label").hidden = !facts.ground.length;
  const colours = [...there, ...Object.keys(ofTrack).filter((key) => !there.includes(key) && track[ofTrack[key]]?.some(finite))];
  fillSelect(at("colour"), ["quality", "severity", ...colours], (key) => ({ quality: "use and quality", severity: "severity" })[key] ?? names[key][0]);
  fillSelect(at("label"), there, (key) => names[key][0]);
  at("label").closest("label").hidden = !there.length;
  at("colour").onchange = paint;
  at("label").onchange = label;

  // One cursor, and what is chosen in words.
  const clock = (t) => {
    const epoch = facts.epochs.findLast(([start]) => t >= start - 0.5) ?? facts.epochs[0];
    const ns = BigInt(epoch[1]) + BigInt(Math.round((t - epoch[0]) * 1e6)) * 1000n;
    return page.clock(Number(ns / 1000000n));
  };
  const segmentAt = (t) => { for (let i = 0; i < n; i++) if (s.start[i] <= t && t <= s.end[i]) return i; return -1; };
  const bitsAt = (t) => { for (let i = 0; i < spans.start.length; i++) if (spans.start[i] <= t && t <= spans.end[i]) return spans.bits[i]; return null; };
  const reasonsAt = (t) => facts.reasons.filter(([bit]) => (bitsAt(t) ?? 0) & bit);
  const values = (t) => facts.lines.flatMap((line) => {
    const one = series[line.series], i = nearest(one.t, t), value = one[line.column][i];
    return finite(value) && Math.abs(one.t[i] - t) <= one.gap_s ? [[`${line.plot} ${line.name}`.trim(), `${value.toPrecision(4)} ${line.unit}`]] : [];
  });
  function point(t) {
    for (const view of panels) model(`cursor ${view.model.name}`).location = t;
    const i = nearest(track.t, t), near = Math.abs(track.t[i] - t) <= track.gap_s;
    model("here").data_source.data = near ? { x: [track.x[i]], y: [track.y[i]] } : { x: [], y: [] };
    const why = reasonsAt(t).map(([, name]) => name), k = segmentAt(t);
    const use = k >= 0 ? `segment ${k + 1}` : bitsAt(t) === null ? "no track" : why.length ? `not used: ${why.join(", ")}` : "kept, not in a segment";
    at("cursor").textContent = [`${t.toFixed(2)} s`, use, ...values(t).map(([name, value]) => `${name} ${value}`)].join(" · ");
  }
  let chosen = null;
  function choose(t) {
    if (chosen !== null) page.keep({ t: t.toFixed(2) });
    chosen = t;
    point(t);
    at("time").value = t;
    const i = segmentAt(t), why = reasonsAt(t);
    const [left, right] = [make("div"), make("div")];
    if (i >= 0) {
      at("row").value = i + 1;
      const flags = facts.quality.filter(([bit]) => s.quality[i] & bit).map(([, words]) => words);
      left.append(make("b", `Segment ${i + 1} of ${n}`), pairs([
        ...Object.values(names).filter(([, name]) => s[name]).map(([called, name, ...kind]) => [called, page.quantity(s[name][i], ...kind, s[`${name}_std`]?.[i])]),
        ["quality", flags.length ? flags.join("; ") : "clean"],
        ["in a dataset", page.explain(`${facts.run}-${facts.starts[i]}`)]]));
    } else {
      left.append(make("b", bitsAt(t) === null ? "No track here" : why.length ? "Not used" : "Kept, but not in a segment"),
        pairs(why.length ? why.map(([, name, words]) => [name, words]) : [["why", bitsAt(t) === null
          ? "no measurements that can be fused" : "steady, but too curved, or shorter than a segment"]]));
    }
    right.append(make("b", `${t.toFixed(2)} s`), pairs([["time", clock(t)], ...(i >= 0 ? [] : values(t))]));
    at("chosen").replaceChildren(left, right);
  }
  const pick = (k) => choose((s.start[k] + s.end[k]) / 2);
  const current = (by) => { const t = chosen ?? first, i = segmentAt(t); return i >= 0 ? i : after(s.start, t) - (by > 0 ? 1 : 0); };
  page.stepThrough(() => n, current, pick);
  document.querySelectorAll(".show").forEach((button) => {
    const { from, to } = button.dataset, found = facts.findings.find(([, , , ...span]) => span[0] === Number(from) && span[1] === Number(to));
    if (!found) return;
    const [start, end] = found, room = Math.max(2, 0.2 * (end - start));
    button.hidden = false;
    button.onclick = () => { zoom(start - room, end + room); choose(start); };
  });
  at("row").max = n;
  [at("time").min, at("time").max] = [first, last];
  at("time").oninput = () => choose(at("time").valueAsNumber);
  if (!n) for (const id of ["before", "after", "row"]) at(id).disabled = true;

  // The mouse and the finger: a point of a plot is a time, one of the map the nearest row of the track.
  const inside = (view, event) => {
    const box = view.canvas_view.el.getBoundingClientRect(), { left, right, top, bottom } = view.frame.bbox;
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    return x >= left && x <= right && y >= top && y <= bottom ? [view.frame.x_scale.invert(x), view.frame.y_scale.invert?.(y), view.frame.x_scale.invert(x + 25) - view.frame.x_scale.invert(x)] : null;
  };
  function listen(view, timeOf) {
    const room = at(view.model.id);
    let pressed = null;
    room.addEventListener("pointermove", (event) => { const t = timeOf(inside(view, event)); if (t !== null && event.pointerType === "mouse") point(t); });
    room.addEventListener("pointerleave", () => { if (chosen !== null) point(chosen); });
    room.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
    room.addEventListener("click", (event) => {
      const t = timeOf(inside(view, event));
      if (t !== null && pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 6) choose(t);
    }, true);
  }
  function join(view) {
    if (view.model.x_range !== range) return;
    panels.push(view);
    redraw([view]);
    if (view.model.name === "label plot") label();
    model(`cursor ${view.model.name}`).location = chosen;
    listen(view, (place) => place && place[0]);
    at(view.model.id).addEventListener("dblclick", () => zoom(first, last));
    if (matchMedia("(pointer: fine)").matches) view.model.toolbar.tools.find((tool) => tool.type === "BoxZoomTool").active = true;
  }
  listen(page.plots.find((view) => view.model.name === "map"), (place) => {
    if (!place) return null;
    let [best, row] = [place[2], -1];
    for (let i = 0; i < track.x.length; i++) {
      const apart = Math.hypot(track.x[i] - place[0], track.y[i] - place[1]);
      if (apart < best) [best, row] = [apart, i];
    }
    return row < 0 ? null : track.t[row];
  });

  const wide = at(model("map").id).clientWidth;
  if (wide < 600) model("map").height = Math.round(Math.min(600, Math.max(240, 90 + (wide - 100) * facts.tall_by_wide)));
  paint();
  if (page.kept.has("t")) choose(Number(page.kept.get("t")) || first);
  else if (n) pick(0);
  else choose(first);
  page.plots.forEach(join);
  return join;
});
