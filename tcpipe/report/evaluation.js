"use strict";
// An evaluation's page: samples measured against predicted and over slope, one of them in words, and the worst with their patches.
const unpacked = page.unpack(page.data.samples);
page.start(async () => {
  const facts = page.data;
  const { at, make, fillSelect, pairs } = page;
  const c = await unpacked;
  const kinds = Object.fromEntries(facts.quantities.map((one) => [one.key, one]));
  const classes = new Map(facts.classes.map((one) => [one.id, one]));
  const source = page.model("samples").data_source;
  const plot = { against: page.model("against"), off: page.model("off") };
  const off = (i, key) => c[`${key} predicted`][i] - c[key][i];
  const splitOf = (i) => facts.splits[c.split[i]], classOf = (i) => classes.get(c.class[i]);
  fillSelect(at("split"), facts.splits.map((one) => one.name));
  fillSelect(at("quantity"), Object.keys(kinds), (key) => kinds[key].called);

  let shown = [];  // rows of the page, the worst first
  function draw() {
    const key = at("quantity").value, split = at("split").value, { called, unit } = kinds[key];
    shown = [...c.split.keys()].filter((i) => (!split || splitOf(i).name === split) && Number.isFinite(off(i, key)));
    shown.sort((a, b) => Math.abs(off(b, key)) - Math.abs(off(a, key)));
    const of = at("colour").value === "split" ? splitOf : classOf;
    const column = (values) => Float64Array.from(shown, values);
    source.selected.indices = [];
    source.data = {
      measured: column((i) => c[key][i]), predicted: column((i) => c[`${key} predicted`][i]), error: column((i) => off(i, key)),
      slope: column((i) => c.slope[i]), fill: shown.map((i) => of(i).colour), class: shown.map((i) => classOf(i).name),
    };
    const ends = (values) => values.filter(Number.isFinite).reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
    const both = ends([...source.data.measured, ...source.data.predicted]);
    page.model("right against").data_source.data = { x: both, y: both };
    page.model("right off").data_source.data = { x: ends([...source.data.slope]), y: [0, 0] };
    plot.against.below[0].axis_label = `${called}, measured [${unit}]`;
    plot.against.left[0].axis_label = `predicted [${unit}]`;
    plot.off.left[0].axis_label = `${called}, predicted less measured [${unit}]`;
    const there = [...new Set(shown.map(of))];
    at("scale").replaceChildren(...page.legend(there.map((one) => [one.name, one.colour])));
    at("row").max = shown.length;
  }

  // One sample in words.
  const cell = new Map((facts.patches?.rows ?? []).map((row, i) => [row, i]));
  function inWords(i) {
    const rows = facts.quantities.map(({ key, called, unit, digits }) => {
      const said = c[`${key} predicted`][i], ends = ["low", "high"].map((end) => page.fixed(said + c[`${key} ${end}`][i], digits));
      const interval = Number.isFinite(c[`${key} low`][i]) ? ` (90 %: ${ends[0]} to ${ends[1]})` : "";
      return [called, `measured ${page.quantity(c[key][i], "", digits, c[`${key} std`][i])}, predicted ${page.fixed(said, digits)}${interval} ${unit}`];
    });
    return [
      ...rows, ["slope", page.quantity(c.slope[i], "°", 1)], ["ground", classOf(i).name], ["split", splitOf(i).name],
      ["where from", page.explain(c.id[i])],
    ];
  }
  function show(places) {
    const box = at("chosen"), { key, unit, digits } = kinds[at("quantity").value];
    box.replaceChildren();
    if (!places.length) {
      box.append(make("p", "Click a point, draw a box, or step through the samples by Next, worst first: the selection appears here."));
      return;
    }
    const i = shown[places[0]];
    at("row").value = places[0] + 1;
    const left = make("div"), right = make("div");
    if (places.length > 1) {
      const errors = places.map((place) => off(shown[place], key)), { mean } = page;
      const kind = facts.classes.map((one) => [one.name, places.filter((place) => c.class[shown[place]] === one.id).length]).filter(([, count]) => count);
      left.append(make("b", `${places.length} chosen`), pairs([
        ["mean error", page.quantity(mean(errors), unit, digits)], ["RMSE", page.quantity(Math.sqrt(mean(errors.map((e) => e * e))), unit, digits)],
        ["ground", kind.map((pair) => pair.join(" ")).join(", ")]]), make("p", "The worst of them:"));
    }
    left.append(pairs(inWords(i)));
    right.append(...(cell.has(i) ? page.patches(facts.patches, cell.get(i)) : [make("p", "The page only contains the patches of the samples with the largest errors of E.", { className: "note" })]));
    box.append(left, right);
  }
  const choose = page.chooseSamples(source, { against: ["measured", "predicted"], off: ["slope", "error"] }, () => shown.length, (places) => show([...places].sort((a, b) => a - b)));
  for (const id of ["split", "quantity", "colour"]) at(id).onchange = () => { draw(); show([]); };
  draw();
  show([]);

  if (facts.patches) {
    const main = facts.quantities[0], cost = (value) => page.quantity(value, main.unit, main.digits);  // E, or T without energy
    page.gallery(facts.patches, (i) => ({
      kind: classOf(i).name, split: splitOf(i).name,
      words: `${classOf(i).name} ${page.quantity(c.slope[i], "°", 1)}, ${cost(c[main.key][i])}, predicted ${cost(c[`${main.key} predicted`][i])}, ${splitOf(i).name}`,
    }), (i) => {
      at("split").value = "";
      draw();
      choose([shown.indexOf(i)]);
    });
  }
});
