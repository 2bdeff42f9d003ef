"use strict";
// The store's page: a table of all runs that sorts and filters, and plots over time; what is chosen in one is chosen in the other.
page.start(() => {
  const { data: facts, at, make, fillSelect } = page;
  const runs = facts.rows.map((row, number) => Object.assign({ number }, ...facts.fields.map((name, i) => ({ [name]: row[i] }))));
  const state_of = (run) => run.superseded_by ? `superseded by ${run.superseded_by}` : run.state;
  const date = (ms) => ms === null ? "" : new Date(ms).toISOString().slice(0, 16).replace("T", " ");
  const digits = (name, places) => (run) => run[name] === null ? "" : page.fixed(run[name], places);
  const columns = [
    ["run", (run) => run.run], ["start_ms", (run) => date(run.start_ms), 1], ["robot", (run) => run.robot], ["state", state_of],
    ["datasets", (run) => run.datasets.map((n) => facts.datasets[n]).join(", ")], ["tags", (run) => run.tags],
    ["segments", digits("segments", 0), 1], ["driven", digits("driven", 0), 1], ["energy", digits("energy", 1), 1], ["wh_per_km", digits("wh_per_km", 1), 1], ["used", digits("used", 1), 1], ["floor", digits("floor", 2), 1],
    ["verdict", (run) => run.verdict], ["findings", digits("findings", 0), 1],
  ];

  // What is shown: the rows of the filters, or those that were chosen in a plot.
  let [by, falls, most, chosen] = ["", false, 25, null];
  const key = (run) => by === "datasets" ? run.datasets.map((n) => facts.datasets[n]).join(", ") : run[by];
  const order = (one, other) => {
    const [a, b] = [key(one), key(other)], lacks = (value) => value === null || value === "";
    if (lacks(a) || lacks(b)) return lacks(a) - lacks(b);
    return (a < b ? -1 : a > b ? 1 : 0) * (falls ? -1 : 1);
  };
  const wanted = () => {
    const [robot, state, dataset, code] = ["robot", "state", "dataset", "code"].map((id) => at(id).value);
    const words = at("find").value.toLowerCase().split(/\s+/).filter(Boolean);
    return runs.filter((run) => (!robot || run.robot === robot) && (!state || run.state === state)
      && (!code || run.codes.includes(Number(code))) && words.every((word) => `${run.run} ${run.tags}`.toLowerCase().includes(word))
      && (!dataset || (dataset === "none" ? !run.datasets.length : run.datasets.includes(Number(dataset)))));
  };
  const table = at("find").closest("section").querySelector("table");
  const heads = [...table.rows[0].cells];
  const more = make("button", "More", { type: "button" });
  table.parentElement.after(more);
  function draw() {
    const found = chosen ?? wanted();
    const sorted = by ? [...found].sort(order) : found;
    [...table.rows].slice(1).forEach((row) => row.remove());
    table.tBodies[0].append(...sorted.slice(0, most).map((run) => {
      const row = make("tr");
      row.append(...columns.map(([name, text, number]) => {
        const cell = make("td", name === "run" && run.href ? "" : text(run), { className: number ? "number" : "" });
        if (name === "run" && run.href) cell.append(make("a", run.run, { href: run.href }));
        if (!number && cell.textContent.length > 16) cell.className = "long";
        return cell;
      }));
      return row;
    }));
    more.hidden = sorted.length <= most;
    at("count").textContent = `${sorted.length} of ${runs.length} runs${chosen ? ", selected in a plot" : ""}`;
    heads.forEach((head, i) => { head.ariaSort = columns[i][0] === by ? (falls ? "descending" : "ascending") : null; });
  }
  heads.forEach((head, i) => {
    const [name, , number] = columns[i];
    const button = make("button", head.textContent, { type: "button", className: "sort" });
    button.onclick = () => { [by, falls] = [name, by === name ? !falls : Boolean(number)]; draw(); };
    head.classList.toggle("number", Boolean(number));
    head.replaceChildren(button);
  });
  more.onclick = () => { most += 100; draw(); };

  // The plots.
  const source = page.model("used")?.data_source;
  const points = runs.filter((run) => run.start_ms !== null);
  const colours = new Map(facts.robots);
  const numbers = (name) => Float64Array.from(points, (run) => run[name] ?? NaN);
  const term = () => {
    const n = at("term")?.selectedIndex ?? -1;
    return Float64Array.from(points, (run) => run.terms[n] ?? NaN);
  };
  let quiet = false;
  if (source) {
    if (at("term")) {
      fillSelect(at("term"), facts.terms);
      const axis = page.model("drift term").left[0];
      at("term").onchange = () => { source.data = { ...source.data, term: term() }; axis.axis_label = at("term").value; };
      axis.axis_label = at("term").value;
    }
    source.data = {
      run: points.map((run) => run.run), start_ms: numbers("start_ms"), fill: points.map((run) => colours.get(run.robot)),
      used: numbers("used"), floor: numbers("floor"), idle: numbers("idle"), term: term(),
    };
    source.selected.change.connect(() => {
      if (quiet) return;
      const picked = source.selected.indices.map((i) => points[i]);
      chosen = picked.length ? picked : null;
      draw();
    });
  }
  const filtered = () => {
    const found = new Set(wanted());
    chosen = null;
    if (source) {
      quiet = true;
      source.selected.indices = found.size === runs.length ? [] : points.flatMap((run, i) => found.has(run) ? [i] : []);
      quiet = false;
    }
    draw();
    page.keep(Object.fromEntries(held.map((id) => [id, at(id).value])));
  };
  const held = ["find", "robot", "state", "dataset", "code"];
  fillSelect(at("robot"), facts.robots.map(([robot]) => robot));
  fillSelect(at("state"), [...new Set(runs.map((run) => run.state))], (state) => `${state} (${runs.filter((run) => run.state === state).length})`);
  fillSelect(at("dataset"), ["none", ...facts.datasets.keys()], (n) => facts.datasets[n] ?? n);
  fillSelect(at("code"), [...facts.codes.keys()], (n) => facts.codes[n]);
  for (const id of ["robot", "state", "dataset", "code"]) at(id).onchange = filtered;
  at("find").oninput = filtered;
  at("clear").onclick = () => {
    for (const id of held) at(id).value = "";
    filtered();
  };
  for (const id of held.filter((name) => page.kept.has(name))) at(id).value = page.kept.get(id);
  if (held.some((id) => at(id).value)) filtered();
  else draw();
});
