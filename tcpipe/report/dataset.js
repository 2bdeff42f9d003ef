"use strict";
// The dataset's page. One selection, made by filters that combine, is shown on the map, in the plots, in words, as patches and as a table.
const unpacked = page.unpack(page.data.samples.packed);
page.start(async () => {
  const facts = page.data;
  const { at, make, fillSelect, pairs, ramp } = page;

  const c = await unpacked;
  const n = c.x.length;
  const source = page.model("samples").data_source;
  const kinds = {
    split: ["split"], class: ["terrain class"], quality: ["quality"], run: ["run"],
    power: ["power w", "W", 0], velocity: ["velocity v", "m/s", 3], duration: ["time T", "s", 3], energy: ["energy E", "J", 0],
    slip: ["slip", "", 3], vibration: ["vibration", "m/s²", 2],
    slope: ["slope along travel", "°", 1], turn: ["turn", "°", 1], power_std: ["σ of w", "W", 1],
    apart: ["way to the nearest train metre", "m", 2],
  };
  const label = (name) => kinds[name][0] + (kinds[name][1] ? ` [${kinds[name][1]}]` : "");
  const classes = new Map(facts.classes.map((one) => [one.id, one]));
  const nameOf = (id) => classes.get(id)?.name ?? "unknown", className = (i) => nameOf(c.class[i]);
  const splitName = (i) => facts.splits[c.split[i]].name;
  const shades = Array.from({ length: 64 }, (_, i) => {
    const place = (i / 63) * (ramp.length - 1), low = Math.min(Math.floor(place), ramp.length - 2), share = place - low;
    const part = (k) => Math.round(parseInt(ramp[low].slice(k, k + 2), 16) * (1 - share) + parseInt(ramp[low + 1].slice(k, k + 2), 16) * share);
    return `rgb(${part(1)},${part(3)},${part(5)})`;
  });
  const digits = (value, name) => page.quantity(value, ...kinds[name].slice(1));

  function coloured(name) {
    const entryOf = {
      split: (s) => [`${facts.splits[s].name} (${facts.splits[s].count})`, facts.splits[s].colour],
      class: (id) => [nameOf(id), classes.get(id)?.colour ?? facts.unknown],
      quality: (q) => (q & facts.flags ? ["carries a flag", facts.flagged] : ["clean", facts.clean]),
      run: (r) => [facts.runs[r].id, facts.colours[r % facts.colours.length]],
    }[name];
    if (entryOf) {
      const entries = new Map([...new Set(c[name])].sort((a, b) => a - b).map((value) => [value, entryOf(value)]));
      at("scale").replaceChildren(...page.legend([...new Map(entries.values())].slice(0, 12)));
      return Array.from(c[name], (value) => entries.get(value)[1]);
    }
    const [low, high] = page.ends(c[name]), span = high - low || 1;
    at("scale").replaceChildren(...page.scale(`${label(name)}: ${digits(low, name)}`, digits(high, name)));
    return Array.from(c[name], (v) => Number.isFinite(v) ? shades[Math.max(0, Math.min(63, Math.floor((63 * (v - low)) / span)))] : facts.unknown);
  }

  const there = (names) => names.filter((name) => c[name]?.some(Number.isFinite));
  const fillKinds = (id, names) => fillSelect(at(id), there(names), (name) => kinds[name][0]);
  const numeric = Object.keys(kinds).filter((name) => kinds[name].length > 1);
  fillKinds("colour", Object.keys(kinds));
  fillKinds("across", ["slope", "velocity", "turn"]);
  fillKinds("up", ["power", "energy", "velocity", "slip", "vibration"]);
  fillKinds("quantity", numeric);
  page.chooseGround(facts.ground);
  const leaks = page.model("leaks");
  at("leaks").onchange = () => {
    const held = Array.from(c.nearest.keys()).filter((i) => c.nearest[i] !== i), near = held.map((i) => c.nearest[i]);
    leaks.data_source.data = { x0: held.map((i) => c.x[i]), y0: held.map((i) => c.y[i]), x1: near.map((i) => c.x[i]), y1: near.map((i) => c.y[i]) };
    leaks.visible = at("leaks").checked;
  };
  at("leaks").disabled = leaks === null || !c.nearest?.some((j, i) => i !== j);
  const brush = page.model("brush");
  const plotted = () => ({ across: Float64Array.from(c[at("across").value]), up: Float64Array.from(c[at("up").value]) });
  source.data = { x: c.x, y: c.y, fill: coloured("split"), ...plotted() };
  at("colour").onchange = () => { source.data = { ...source.data, fill: coloured(at("colour").value) }; };
  const labelAxes = () => {
    brush.below[0].axis_label = label(at("across").value);
    brush.left[0].axis_label = label(at("up").value);
  };
  labelAxes();
  at("across").onchange = at("up").onchange = () => {
    source.data = { ...source.data, ...plotted() };
    labelAxes();
    drawHere();
  };

  // The selection: rows that pass all filters; none without a filter. `current` is the one of them that is shown in words.
  const filters = new Map(), held = ["run", "class", "split", "flag", "quantity", "least", "most"];
  const passes = (i, without) => [...filters].every(([name, passed]) => name === without || passed(i));
  let [selected, current, isLone] = [[], -1, false];
  function setFilter(name, passed) {
    if (name !== "picked" && isLone) filters.delete("picked");  // a single sample would leave nothing to filter
    if (passed) filters.set(name, passed);
    else filters.delete(name);
    selected = filters.size ? [...c.x.keys()].filter((i) => passes(i)) : [];
    current = passes(current) && filters.size ? current : selected[0] ?? -1;
    drawSelection();
  }
  function pick(rows) {
    if (rows.length === 1 && !passes(rows[0], "picked")) clear();
    isLone = rows.length === 1;
    const picked = new Set(rows);
    setFilter("picked", rows.length ? (i) => picked.has(i) : null);
  }
  function clear() {
    filters.clear();
    ["run", "class", "split", "flag", "least", "most"].forEach((id) => { at(id).value = ""; });
    setFilter("picked", null);
  }
  const choices = {
    run: [[...facts.runs.keys()], (k) => facts.runs[k].id, (k) => (i) => c.run[i] === k],
    class: [[...new Set(c.class)].sort((a, b) => a - b), nameOf, (k) => (i) => c.class[i] === k],
    split: [[...facts.splits.keys()].filter((k) => facts.splits[k].count), (k) => facts.splits[k].name, (k) => (i) => c.split[i] === k],
    flag: [facts.quality.map(([bit]) => bit).filter((bit) => c.quality.some((q) => q & bit)), (k) => facts.quality.find(([bit]) => bit === k)[1],
      (k) => (i) => (k ? c.quality[i] & k : !(c.quality[i] & facts.flags))],
  };
  for (const [id, [values, text, passed]] of Object.entries(choices)) {
    fillSelect(at(id), values, text);
    at(id).onchange = () => setFilter(id, at(id).value === "" ? null : passed(Number(at(id).value)));
  }
  function setRange() {
    const values = c[at("quantity").value], given = (id, open) => (at(id).value === "" ? open : at(id).valueAsNumber);
    const [least, most] = [given("least", -Infinity), given("most", Infinity)];
    setFilter("range", least > -Infinity || most < Infinity ? (i) => values[i] >= least && values[i] <= most : null);
  }
  at("least").onchange = at("most").onchange = setRange;
  at("quantity").onchange = () => {
    at("least").value = at("most").value = "";
    setRange();
  };
  page.model("histogram").on_event("selectiongeometry", ({ geometry: { x0, x1 } }) => {
    at("least").value = Number(Math.min(x0, x1).toPrecision(4));
    at("most").value = Number(Math.max(x0, x1).toPrecision(4));
    setRange();
  });
  for (const [name, axes] of [["map", ["x", "y"]], ["brush", ["across", "up"]]]) {
    page.clickNearest(name, source, axes, (i) => passes(i, "picked"), (i, adds) => {
      pick(adds ? (selected.includes(i) ? selected.filter((k) => k !== i) : [...selected, i]) : [i]);
    });
  }
  let drawing = false;
  source.selected.change.connect(() => { if (!drawing) pick([...source.selected.indices]); });

  const bins = 40;
  const histogram = page.model("histogram"), bars = page.model("bars").data_source, here = page.model("here").data_source;
  function drawHistogram() {
    const name = at("quantity").value, values = c[name], known = values.filter(Number.isFinite);
    const [low, high] = known.reduce(([least, most], v) => [Math.min(least, v), Math.max(most, v)], [Infinity, -Infinity]);
    const width = (high - low) / bins || 1, all = new Array(bins).fill(0), chosen = [...all];
    const binOf = (v) => Math.min(bins - 1, Math.floor((v - low) / width));
    known.forEach((v) => { all[binOf(v)] += 1; });
    selected.forEach((i) => { if (Number.isFinite(values[i])) chosen[binOf(values[i])] += 1; });
    bars.data = { left: all.map((_, k) => low + k * width), right: all.map((_, k) => low + (k + 1) * width), all, chosen };
    histogram.below[0].axis_label = label(name);
  }
  function drawHere() {
    here.data = Object.fromEntries(Object.entries(source.data).map(([name, values]) => [name, current < 0 ? [] : [values[current]]]));
  }
  function focus(i) {
    current = i;
    drawHere();
    drawWords();
    drawPage();
  }
  function drawSelection() {
    drawing = true;
    source.selected.indices = selected;
    drawing = false;
    first = 0;
    drawHistogram();
    drawHere();
    drawWords();
    drawPage();
    drawExport();
    const chosen = filters.has("picked") && selected.length <= 200 ? selected.join() : "";
    page.keep(filters.size ? { ...Object.fromEntries(held.map((id) => [id, at(id).value])), samples: chosen } : {});
  }
  at("filters").closest("section").querySelector(".figures").append(at("filters"));  // beside the histogram
  page.stepThrough(
    () => (selected.length > 1 ? selected.length : n),
    (by) => (selected.length > 1 ? selected.indexOf(current) : current < 0 && by < 0 ? 0 : current),
    (k) => (selected.length > 1 ? focus(selected[k]) : pick([k])),
  );
  at("clear").onclick = clear;

  // One sample in words.
  const directory = location.protocol === "file:" ? decodeURIComponent(new URL(".", location).pathname).replace(/(.)\/$/, "$1") : "dataset";
  const sheets = facts.patches;
  const cell = new Map((sheets?.rows ?? []).map((row, i) => [row, i]));
  const start = (i) => BigInt(facts.runs[c.run[i]].first_ns) + BigInt(c.after_s[i]) * 1000000000n + BigInt(c.after_ns[i]);
  const idOf = (i) => facts.samples.ids ? facts.samples.ids[i] : `${facts.runs[c.run[i]].id}-${start(i)}`;
  const flagsOf = (i) => facts.quality.filter(([bit]) => c.quality[i] & bit).map(([, words]) => words).join("; ") || "clean";
  const withStd = (i, name) => page.quantity(c[name][i], kinds[name][1], kinds[name][2] + 1, c[`${name}_std`]?.[i]);
  const noPicture = sheets ? `The page carries ${sheets.rows.length} of ${facts.count} patches; tcpipe.open_dataset reads all.` : "";
  const labelsOf = (i) => [
    ...there(["power", "velocity", "duration", "energy", "slip", "vibration"]).map((name) => [kinds[name][0], withStd(i, name)]),
    ...there(["slope"]).map((name) => [name, digits(c.slope[i], name)]), ["turn", digits(c.turn[i], "turn")],
    ["ground", className(i)],
  ];
  function originOf(i) {
    const run = facts.runs[c.run[i]];
    return [
      ["split", splitName(i)], ...(Number.isFinite(c.apart[i]) ? [["nearest train", digits(c.apart[i], "apart")]] : []), ["quality", flagsOf(i)],
      ["run", run.href ? make("a", run.id, { href: run.href }) : run.id], ["time", page.clock(Number(start(i) / 1000000n))], ["where from", page.explain(idOf(i), directory)],
    ];
  }
  function drawWords() {
    const box = at("chosen");
    box.replaceChildren();
    if (current < 0) {
      const nothing = filters.size ? "No sample passes all filters." : "Click a sample on the map or in the plot, draw a box, or set a filter: the selection appears here.";
      box.append(make("p", nothing));
      return;
    }
    at("row").max = selected.length > 1 ? selected.length : n;
    at("row").value = selected.length > 1 ? selected.indexOf(current) + 1 : current + 1;
    const [left, middle, right] = [make("div"), make("div"), make("div")];
    if (selected.length > 1) {
      const mean = (name) => page.mean(selected.map((k) => c[name][k]).filter(Number.isFinite));
      const by = facts.splits.map((s, k) => [s.name, selected.filter((j) => c.split[j] === k).length]).filter(([, count]) => count);
      left.append(make("b", `${selected.length} selected`), pairs([
        ...there(["power", "velocity", "energy", "slope"]).map((name) => [`mean ${kinds[name][0]}`, digits(mean(name), name)]),
        ["splits", by.map(([name, count]) => `${name} ${count}`).join(", ")],
        ["flagged", `${selected.filter((j) => c.quality[j] & facts.flags).length}`]]), make("p", `Number ${selected.indexOf(current) + 1} of them:`));
    }
    left.append(pairs(labelsOf(current)));
    right.append(pairs(originOf(current)));
    middle.append(...(cell.has(current) ? page.patches(sheets, cell.get(current)) : [make("p", noPicture, { className: "note" })]));
    box.append(left, middle, right);
  }

  // A page of the selection as patches and rows; without a selection, patches that are inside the page.
  const perPage = 24;
  let first = 0;
  const orders = {
    "order of the dataset": null,
    ...(there(["power"]).length && {
      "σ of w": (i) => c.power_std[i],
      "w, largest first": (i) => c.power[i],
      "w, smallest first": (i) => -c.power[i],
    }),
  };
  fillSelect(at("sort"), Object.keys(orders));
  page.fillLayers(at("layer"), sheets?.layers ?? []);
  function drawPage() {
    const key = orders[at("sort").value], rows = [...(filters.size ? selected : sheets?.rows ?? [])];
    if (key) {
      const value = (i) => (Number.isFinite(key(i)) ? key(i) : -Infinity);
      rows.sort((a, b) => value(b) - value(a) || a - b);
    }
    const shown = rows.slice(first, first + perPage);
    at("gallery").replaceChildren(...(sheets ? shown : []).map((i) => {
      const button = make("button", "", { type: "button", ariaPressed: `${i === current}` });
      const layer = sheets.layers.find((one) => one.name === at("layer").value);
      button.append(cell.has(i) ? page.patch(sheets, layer, cell.get(i), 92) : make("span", "not in this page", { className: "patch" }));
      button.append([className(i), ...there(["slope", "power"]).map((name) => digits(c[name][i], name)), splitName(i)].join(", "));
      button.onclick = () => {
        if (selected.length > 1) focus(i);
        else pick([i]);
        at("gallery").querySelector("[aria-pressed=true]")?.focus();  // it is another button now
      };
      return button;
    }));
    at("no-picture").hidden = !sheets || shown.every((i) => cell.has(i));
    at("no-picture").textContent = noPicture;
    at("page-count").textContent = rows.length ? `${first + 1} to ${first + shown.length} of ${rows.length}` : "none";
    at("page-before").disabled = first === 0;
    at("page-after").disabled = first + perPage >= rows.length;
    const columns = [
      ["sample_id", idOf], ["split", splitName], ["class", className], ["w", (i) => withStd(i, "power")], ["v", (i) => withStd(i, "velocity")],
      ["E", (i) => withStd(i, "energy")], ["quality", flagsOf],
    ];
    const line = (tag, texts) => {
      const row = make("tr");
      row.append(...texts.map((text) => make(tag, text)));
      return row;
    };
    at("rows").replaceChildren(line("th", columns.map(([name]) => name)), ...(selected.length ? shown : []).map((i) => line("td", columns.map(([, text]) => text(i)))));
  }
  const turnTo = (row) => { first = row; drawPage(); };
  at("sort").onchange = at("layer").onchange = () => turnTo(0);
  at("page-before").onclick = () => turnTo(first - perPage);
  at("page-after").onclick = () => turnTo(first + perPage);

  // Its ids, and what opens them.
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  function drawExport() {
    const part = facts.count > n ? ` The selection covers the ${n} samples that the page shows, drawn at random from ${facts.count}.` : "";
    const words = filters.size ? `${selected.length} of ${n} samples are selected.` : `Nothing is selected: examples of every split, class and slope.`;
    at("selection-count").textContent = words + part;
    at("selected").hidden = !selected.length;
    at("copy-ids").textContent = "Copy sample_ids";
    const splits = new Set(selected.map(splitName)), of = splits.size === 1 ? `[${JSON.stringify([...splits][0])}]` : "";
    const ids = selected.length > 3 ? '"sample_ids.csv"' : JSON.stringify(selected.map(idOf));
    at("python").textContent = `import tcpipe\ntcpipe.open_dataset(${JSON.stringify(directory)})${of}.select(${ids})`;
  }
  at("download").onclick = () => {
    const lines = selected.map((i) => `${quoted(idOf(i))},${splitName(i)}\n`);
    const href = URL.createObjectURL(new Blob(["sample_id,split\n", ...lines], { type: "text/csv" }));
    make("a", "", { href, download: "sample_ids.csv" }).click();
  };
  at("copy-ids").onclick = () => {
    const isCopied = page.copy(selected.map((i) => `${idOf(i)}\n`).join(""));
    at("copy-ids").textContent = isCopied ? "Copied" : "The browser does not copy: download them";
  };
  for (const id of held.filter((name) => page.kept.has(name))) {
    at(id).value = page.kept.get(id);
    if (id in choices) at(id).onchange();
  }
  if (page.kept.has("least") || page.kept.has("most")) setRange();
  if (page.kept.has("samples")) pick(page.kept.get("samples").split(",").map(Number).filter((i) => i >= 0 && i < n));
  drawSelection();
});
