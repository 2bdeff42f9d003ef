"use strict";
// The frame's script: it draws the page's figures, and draws them again when the colour scheme turns. `page` is what other scripts need.
const page = (() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const drawn = read("page-figures");
  const plots = [];
  let ready = Promise.resolve();
  if (drawn !== null) {
    Bokeh.set_log_level("warn");
    const roots = drawn.roots.map((root) => root.id);
    const item = { docid: "page", root_ids: roots, roots: Object.fromEntries(roots.map((id) => [id, id])) };
    ready = Bokeh.embed.embed_items({ page: drawn }, [item]).then((managers) => {
      for (const manager of managers) plots.push(...[...manager].filter((view) => "request_paint" in view));
    });
  }
  const repaint = () => plots.forEach((plot) => plot.request_paint());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  matchMedia("print").addEventListener("change", repaint);
  return {
    data: read("page-data"),
    ready,
    plots,
    model: (name) => Bokeh.documents[0].get_model_by_name(name),
  };
})();
