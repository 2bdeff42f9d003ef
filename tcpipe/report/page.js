"use strict";
// The frame's script: it draws the page's figures, and draws them again when the colour scheme turns. `page` is what other scripts need.
const page = (() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const figures = read("page-figures");
  const plots = [];
  let views = [];
  async function draw({ first, later }) {
    Bokeh.set_log_level("warn");
    const ids = [...first.roots, ...later].map((root) => root.id);
    const item = { docid: "page", root_ids: ids, roots: Object.fromEntries(ids.map((id) => [id, id])) };
    [views] = await Bokeh.embed.embed_items({ page: first }, [item]);
    plots.push(...[...views].filter((view) => "request_paint" in view));
    if (matchMedia("(pointer: coarse)").matches) plots.forEach((view) => view.model.toolbar.tools.forEach((tool) => { if (/^(Pan|BoxSelect)Tool$/.test(tool.type)) tool.active = false; }));  // a finger scrolls
  }
  const state = document.documentElement.dataset;
  let [printing, goOn] = [false, () => {}];
  const turn = () => new Promise((next) => {
    goOn = next;
    if (printing) next();
    else setTimeout(next, 0);
  });
  async function join(root) {
    await turn();
    Bokeh.documents[0].apply_json_patch({ events: [{ kind: "RootAdded", model: root }] });
    const drawn = () => [...views].find((view) => view.model.id === root.id);
    while (!drawn()) await turn();
    plots.push(drawn());
    return drawn();
  }
  // What scripts ask for is drawn first; the others follow when the page answers.
  const first = figures ? draw(figures) : Promise.resolve();
  let work = async () => {};
  document.addEventListener("DOMContentLoaded", async () => {
    await first;
    const joined = await work();
    state.ready = "yes";
    for (const root of figures?.later ?? []) {
      const view = await join(root);
      joined?.(view);
    }
    state.whole = "yes";
  });
  const repaint = () => plots.forEach((plot) => plot.request_paint());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  // Before a page prints, no timer fires and no canvas on the page may change its size, but promises are waited for. So the figures
  // that are missing join by promises alone (so many at most), and the paper gets a copy of each, in its colours, as wide as it allows.
  addEventListener("beforeprint", async () => {
    state.prints = "yes";
    printing = true;
    goOn();
    for (let i = 0; !state.whole && i < 10_000; i++) await null;
    printing = false;
    for (const plot of plots) {
      plot.repaint();  // which gives it its ranges and its layout
      document.getElementById(plot.model.id).after(plot.export("png").canvas);
    }
  });
  addEventListener("afterprint", () => {
    delete state.prints;
    document.querySelectorAll("figure > canvas").forEach((copy) => copy.remove());
    repaint();
  });

  document.querySelectorAll(".copy").forEach((button) => {
    button.onclick = () => { button.textContent = copy(button.previousElementSibling.textContent) ? "Copied" : "The browser does not copy"; };
  });

  // What the pages' own scripts share.
  const model = (name) => figures ? Bokeh.documents[0].get_model_by_name(name) : null;
  const at = (id) => document.getElementById(id);
  const make = (tag, text = "", more = {}) => Object.assign(document.createElement(tag), { textContent: text }, more);
  function fillSelect(select, names, text = (name) => name) {
    select.append(...names.map((name) => make("option", text(name), { value: name })));
  }
  function pairs(rows) {
    const list = make("dl");
    for (const [name, value] of rows) {
      const shown = make("dd");
      shown.append(value);
      list.append(make("dt", name), shown);
    }
    return list;
  }
  function bytesOf(base64) {
    const text = atob(base64), found = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) found[i] = text.charCodeAt(i);
    return found;
  }
  // Where a sheet's picture is: once as a blob, for its text would stand in the style of every patch.
  function addressOf(layer) {
    const inside = layer.uri.match(/^data:(.*);base64,/);
    if (inside) layer.uri = URL.createObjectURL(new Blob([bytesOf(layer.uri.slice(inside[0].length))], { type: inside[1] }));
    return layer.uri;
  }
  // Patch number i of sheets as a square, by one of their layers.
  function patch(sheets, layer, i, side) {
    const shown = make("span", "", { className: "patch", role: "img", ariaLabel: `${layer.name} patch` });
    const scale = side / sheets.px;
    shown.style.cssText = `width:${side}px;height:${side}px;background-image:url(${addressOf(layer)});background-size:${sheets.across * side}px auto;`
      + `background-position:${-(i % sheets.across) * sheets.px * scale}px ${-Math.floor(i / sheets.across) * sheets.px * scale}px`;
    return shown;
  }
  function patches(sheets, i) {
    const room = make("div", "", { className: "patches" });
    for (const layer of sheets.layers) {
      const figure = make("figure");
      figure.append(patch(sheets, layer, i, 96), make("figcaption", layer.name));
      room.append(figure);
    }
    return [room, make("p", "Travel is to the right; height uses the range of the patch.", { className: "note" })];
  }
  const legend = (entries) => entries.map(([text, colour]) => {
    const dot = make("i"), entry = make("span");
    dot.style.background = colour;
    entry.append(dot, text);
    return entry;
  });
  // Of a number's colours, the values at both ends: 2 of 100 lie below the lower, 2 above the upper.
  const ramp = ["#00224e", "#2a3f6d", "#575d6d", "#7d7c78", "#a59c74", "#d2c060", "#fee838"];
  function ends(values) {
    const known = Float64Array.from(values).filter(Number.isFinite).sort();
    return [0.02, 0.98].map((share, end) => known[Math[end ? "ceil" : "floor"](share * (known.length - 1))]);
  }
  function scale(low, high) {
    const bar = make("span", "", { className: "ramp" });
    bar.style.background = `linear-gradient(to right, ${ramp.join()})`;
    return [make("span", low), bar, make("span", `${high} (96 of 100 lie between)`)];
  }
  const clock = (ms) => `${new Date(ms).toISOString().replace("T", " ").replace("Z", "")} UTC`;
  const explain = (id, dataset = "dataset") => make("code", `tcpipe explain ${[id, "--dataset", dataset].map((word) => (/^[\w./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`)).join(" ")}`);
  // What is chosen is a part of the page's address, so that a link leads to it.
  const kept = new URLSearchParams(location.hash.slice(1));
  function keep(values) {
    const words = new URLSearchParams(Object.entries(values).filter(([, value]) => value !== "" && value !== null));
    history.replaceState(null, "", `${location.href.split("#")[0]}${words.size ? "#" : ""}${words}`);
  }
  // Pictures under a map, one of which is seen.
  function chooseGround(names) {
    fillSelect(at("ground"), [...names, "none"]);
    at("ground").onchange = () => names.forEach((name) => { model(`layer ${name}`).visible = name === at("ground").value; });
  }
  // Copies a text and returns whether the browser did; pages without a server are not allowed to use `navigator.clipboard`.
  function copy(text) {
    const area = make("textarea", text), focused = document.activeElement;
    document.body.append(area);
    area.select();
    const copied = document.execCommand("copy");
    area.remove();
    focused.focus({ preventScroll: true });
    return copied;
  }
  function fillLayers(select, layers) {
    fillSelect(select, layers.map((layer) => layer.name));
    if (layers.some((layer) => layer.name === "ortho")) select.value = "ortho";
  }
  // What is chosen, below a short summary or the first row of figures, and buttons that go through `count()` rows from row `current(by)`.
  function stepThrough(count, current, choose) {
    const summary = document.querySelector(".summary"), room = make("div", "", { className: "selection" });
    const figures = [...at("chosen").closest("section").querySelectorAll("figure")], bottom = (part) => part.getBoundingClientRect().bottom;
    room.append(at("chosen"), at("stepping"));
    if (matchMedia("(min-width: 64rem)").matches && bottom(summary) < bottom(figures[0])) summary.append(room);
    else figures.findLast((one) => one.offsetTop === figures[0].offsetTop).after(room);
    const step = (by) => { const n = count(); if (n) choose((current(by) + by + n) % n); };
    at("before").onclick = () => step(-1);
    at("after").onclick = () => step(1);
    at("row").onchange = () => { const i = at("row").valueAsNumber - 1; if (i >= 0 && i < count()) choose(i); };
  }
  // A click on a plot takes the nearest point that is `allowed`, at most 30 pixels away: `choose(row, whether shift is pressed)`.
  function clickNearest(name, source, [x, y], allowed, choose) {
    model(name).on_event("tap", ({ sx, sy, modifiers }) => {
      const { x_scale, y_scale } = plots.find((one) => one.model.name === name).frame;
      const [across, down] = [x_scale.v_compute(source.data[x]), y_scale.v_compute(source.data[y])];
      let [nearest, least] = [-1, 30 ** 2];
      for (let i = 0; i < across.length; i++) {
        const apart = (across[i] - sx) ** 2 + (down[i] - sy) ** 2;
        if (apart < least && allowed(i)) [nearest, least] = [i, apart];
      }
      if (nearest >= 0) choose(nearest, modifiers.shift);
    });
  }
  const fixed = (value, digits) => (Number(value.toFixed(digits)) + 0).toFixed(digits);  // no -0.0
  // A value with its unit, to two digits of its σ; to `digits` decimals at most, and without a σ.
  function quantity(value, unit, digits, std = NaN) {
    if (!Number.isFinite(value)) return "none";
    const places = std > 0 ? Math.max(0, Math.min(digits, 1 - Math.floor(Math.log10(std)))) : digits;
    const sigma = Number.isFinite(std) ? ` ± ${places < digits ? fixed(std, places) : std.toPrecision(2)}` : "";
    return `${fixed(value, places)}${sigma}${unit && unit !== "°" ? "\u00a0" : ""}${unit}`;
  }
  const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;
  // Columns as `tcpipe.report.page` wrote them.
  async function unpack({ columns, data }) {
    const stream = new Blob([bytesOf(data)]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const whole = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array };
    return Object.fromEntries(columns.map(({ name, kind, at: first, bytes, low, step }) => {
      const part = buffer.slice(first, first + bytes);
      if (kind in whole) return [name, new whole[kind](part)];
      const halves = new Uint16Array(part);
      if (kind === "steps") return [name, Float64Array.from(halves, (n) => (n === 65535 ? NaN : low + step * n))];
      const count = kind === "half" ? halves.length : halves.length / 2;
      const bits = new Uint32Array(count);
      for (let i = 0; i < count; i++) bits[i] = ((halves[i] << 16) | (kind === "half" ? 0 : halves[count + i])) >>> 0;
      return [name, new Float32Array(bits.buffer)];
    }));
  }
  return {
    at, copy, fixed, keep, kept, make, fillLayers, fillSelect, pairs, patch, patches, legend, ramp, ends, scale, clock, explain, chooseGround, clickNearest, mean, quantity, stepThrough, unpack,
    data: read("page-data"),
    // What a page's own script does when the figures that it asks for are drawn; what it returns is called with the view of each that follows.
    start: (of) => { work = of; },
    plots,
    model,
  };
})();
