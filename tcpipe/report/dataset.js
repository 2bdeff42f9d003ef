"use strict";
// The dataset's page: samples on the map and in the plot, one of them in words with its patch, and the gallery.
const unpacked = page.unpack(page.data.samples.packed);
page.start(async () => {
  const told = page.data;
  const { at, make, fillSelect, pairs, ramp } = page;

  const c = await unpacked;
  const n = c.x.length;
  const source = page.model("samples").data_source;
  const kinds = {
    split: ["split"], class: ["terrain class"], quality: ["quality"], run: ["run"],
    power: ["power w", "W", 0], velocity: ["velocity v", "m/s", 2], duration: ["time T", "s", 2], energy: ["energy E", "J", 0],
    slope: ["slope along travel", "°", 1], turn: ["turn", "°", 1], residual: ["w beyond physics", "W", 0],
    apart: ["way to the nearest train metre", "m", 2],
  };
  const label = (name) => kinds[name][0] + (kinds[name][1] ? ` [${kinds[name][1]}]` : "");
  const classes = new Map(told.classes.map((one) => [one.id, one]));
  const shades = Array.from({ length: 64 }, (_, i) => {
    const place = (i / 63) * (ramp.length - 1), low = Math.min(Math.floor(place), ramp.length - 2), share = place - low;
    const part = (k) => Math.round(parseInt(ramp[low].slice(k, k + 2), 16) * (1 - share) + parseInt(ramp[low + 1].slice(k, k + 2), 16) * share);
    return `rgb(${part(1)},${part(3)},${part(5)})`;
  });
  const digits = (value, name) => Number.isFinite(value) ? `${value.toFixed(kinds[name][2])}\u00a0${kinds[name][1]}` : "none";

  function coloured(name) {
    const legend = [];
    let fill;
    if (name === "split") {
      fill = Array.from(c.split, (s) => told.splits[s].colour);
      told.splits.forEach((s) => s.count && legend.push([`${s.name} (${s.count})`, s.colour]));
    } else if (name === "class") {
      const colour = (id) => classes.get(id)?.colour ?? told.unknown;
      fill = Array.from(c.class, colour);
      [...new Set(c.class)].sort((a, b) => a - b).forEach((id) => legend.push([classes.get(id)?.name ?? "unknown", colour(id)]));
    } else if (name === "quality") {
      fill = Array.from(c.quality, (q) => (q & told.flags ? told.flagged : told.clean));
      legend.push(["clean", told.clean], ["carries a flag", told.flagged]);
    } else if (name === "run") {
      fill = Array.from(c.run, (r) => told.colours[r % told.colours.length]);
      told.runs.slice(0, 12).forEach((r, i) => legend.push([r.id, told.colours[i % told.colours.length]]));
    } else {
      const [low, high] = page.ends(c[name]);
      fill = Array.from(c[name], (v) => Number.isFinite(v)
        ? shades[Math.max(0, Math.min(63, Math.floor(63 * (v - low) / ((high - low) || 1))))] : told.unknown);
      legend.push([low, high]);
    }
    const scale = at("scale");
    scale.replaceChildren();
    scale.className = "controls legend";
    if (typeof legend[0]?.[0] === "number") {
      scale.append(...page.scale(`${label(name)}: ${digits(legend[0][0], name)}`, digits(legend[0][1], name)));
    } else {
      scale.append(...page.legend(legend));
    }
    return fill;
  }

  const there = (names) => names.filter((name) => name in c && (name !== "apart" || c.apart.some(Number.isFinite)));
  fillSelect(at("colour"), there(Object.keys(kinds)), (name) => kinds[name][0]);
  fillSelect(at("across"), there(["slope", "velocity", "turn", "residual"]), (name) => kinds[name][0]);
  fillSelect(at("up"), there(["power", "energy", "velocity"]), (name) => kinds[name][0]);
  page.chooseGround(told.ground);
  for (const [id, name] of [["next", "drive next"], ["leaks", "leaks"]]) {
    const drawn = page.model(name);
    at(id).onchange = () => {
      if (name === "leaks") {
        const held = Array.from(c.nearest.keys()).filter((i) => c.nearest[i] !== i), near = held.map((i) => c.nearest[i]);
        drawn.data_source.data = { x0: held.map((i) => c.x[i]), y0: held.map((i) => c.y[i]), x1: near.map((i) => c.x[i]), y1: near.map((i) => c.y[i]) };
      }
      drawn.visible = at(id).checked;
    };
    at(id).disabled = drawn === null || (name === "leaks" && !c.nearest?.some((j, i) => i !== j));
  }
  const brush = page.model("brush");
  const plotted = () => ({ across: Float64Array.from(c[at("across").value]), up: Float64Array.from(c[at("up").value]) });
  const replot = () => {
    source.data = { ...source.data, ...plotted() };
    brush.below[0].axis_label = label(at("across").value);
    brush.left[0].axis_label = label(at("up").value);
  };
  source.data = { x: c.x, y: c.y, fill: coloured("split"), ...plotted() };
  at("colour").onchange = () => { source.data = { ...source.data, fill: coloured(at("colour").value) }; };
  at("across").onchange = at("up").onchange = replot;

  // One sample in words.
  const sheets = told.patches;
  const cell = new Map((sheets?.rows ?? []).map((row, i) => [row, i]));
  const start = (i) => BigInt(told.runs[c.run[i]].first_ns) + BigInt(c.after_s[i]) * 1000000000n + BigInt(c.after_ns[i]);
  const idOf = (i) => told.samples.ids ? told.samples.ids[i] : `${told.runs[c.run[i]].id}-${start(i)}`;
  function inWords(i) {
    const flags = told.quality.filter(([bit]) => c.quality[i] & bit).map(([, words]) => words);
    const rows = ["power", "velocity", "duration", "energy"].map((name) => {
      const std = c[`${name}_std`]?.[i];
      return [kinds[name][0], Number.isFinite(std) ? `${c[name][i].toFixed(kinds[name][2] + 1)} ± ${std.toPrecision(2)} ${kinds[name][1]}` : digits(c[name][i], name)];
    });
    rows.push(["slope", digits(c.slope[i], "slope")], ["turn", digits(c.turn[i], "turn")]);
    if (c.residual) rows.push(["beyond physics", digits(c.residual[i], "residual")]);
    rows.push(["ground", classes.get(c.class[i])?.name ?? "unknown"], ["split", told.splits[c.split[i]].name]);
    if (Number.isFinite(c.apart[i])) rows.push(["nearest train", digits(c.apart[i], "apart")]);
    rows.push(["quality", flags.length ? flags.join("; ") : "clean"]);
    const run = told.runs[c.run[i]];
    rows.push(["run", run.href ? make("a", run.id, { href: run.href }) : run.id]);
    rows.push(["time", page.clock(Number(start(i) / 1000000n))]);
    rows.push(["where from", page.explain(idOf(i))]);
    return rows;
  }
  function show(chosen) {
    const box = at("chosen");
    box.replaceChildren();
    if (!chosen.length) {
      box.append(make("p", "Click a point on the map, or draw a box in the plot: the samples appear here."));
      return;
    }
    const i = chosen[0];
    at("row").value = i + 1;
    const left = make("div"), right = make("div");
    if (chosen.length > 1) {
      const mean = (name) => page.mean(chosen.map((k) => c[name][k]).filter(Number.isFinite));
      const by = told.splits.map((s, k) => [s.name, chosen.filter((j) => c.split[j] === k).length]).filter(([, count]) => count);
      left.append(make("b", `${chosen.length} chosen`), pairs([
        ...["power", "velocity", "energy", "slope"].map((name) => [`mean ${kinds[name][0]}`, digits(mean(name), name)]),
        ["splits", by.map(([name, count]) => `${name} ${count}`).join(", ")],
        ["flagged", `${chosen.filter((j) => c.quality[j] & told.flags).length}`]]), make("p", "The first of them:"));
    }
    left.append(pairs(inWords(i)));
    if (sheets && cell.has(i)) {
      right.append(...page.patches(sheets, cell.get(i)));
    } else if (sheets && told.folder) {
      const layers = sheets.layers.map(({ name }, k) => ({ name, uri: `${told.folder}/${k}-${Math.floor(i / told.per_sheet)}.webp` }));
      right.append(...page.patches({ ...sheets, layers }, i % told.per_sheet));
      const lost = () => right.replaceChildren(make("p", `${told.folder} is not beside this page.`, { className: "note" }));
      Object.assign(new Image(), { src: layers[0].uri, onerror: lost });
    } else if (sheets) {
      right.append(make("p", `The page carries ${sheets.rows.length} of ${told.count} patches, and this one is not among them; 'tcpipe report --patches' puts all beside it.`, { className: "note" }));
    }
    box.append(left, right);
  }
  const choose = page.chooseSamples(source, () => n, show);
  at("row").max = n;
  show([]);

  if (sheets) {
    page.gallery(sheets, (i) => {
      const [kind, split] = [classes.get(c.class[i])?.name ?? "unknown", told.splits[c.split[i]].name];
      return { kind, split, words: `${kind} ${digits(c.slope[i], "slope")}, ${digits(c.power[i], "power")}, ${split}` };
    }, (i) => choose([i]));
  }
});
