// The plots: drawn by Vega, told which runs are shown and chosen; a brush in one filters all.
const COARSE = matchMedia("(pointer: coarse)").matches; // a finger scrolls: there a drag must not brush
const VIEWS = [];
const EMBED = { actions: { export: { svg: true, png: true }, source: false, compiled: false, editor: false }, renderer: "canvas",
  tooltip: { theme: "light" } };

function rowsFor(fields) {
  return Array.from({ length: RUNS }, (_, i) => {
    const row = { i, run: COLUMNS.run[i], verdict: COLUMNS.verdict[i] };
    for (const name of fields) row[name] = COLUMNS[name][i];
    return row;
  });
}

function withoutBrush(spec) {
  const copy = structuredClone(spec);
  const strip = (part) => { if (part.params) part.params = part.params.filter((param) => param.name !== "brush"); };
  strip(copy);
  (copy.layer || []).forEach(strip);
  return copy;
}

async function drawPanel(panel, number) {
  const chart = element("div", { class: "chart" });
  document.getElementById("plots").append(element("figure", {}, element("figcaption", {}, panel.question), chart));
  const spec = COARSE ? withoutBrush(panel.spec) : structuredClone(panel.spec);
  const rows = rowsFor(panel.fields).filter((row) => row[panel.x] !== null && row[panel.x] !== undefined);
  spec.datasets = { runs: rows };
  const { view } = await vegaEmbed(chart, spec, EMBED);
  if (!COARSE) {
    view.addSignalListener("brush", (_, value) => {
      state.brushes[number] = value && Object.keys(value).length ? value : {};
      changed();
    });
  }
  view.addEventListener("click", (_, item) => { if (item && item.datum && item.datum.i !== undefined) choose(item.datum.i); });
  VIEWS[number] = view;
}

async function drawPlots() {
  if (COARSE) document.getElementById("plots-hint").textContent = "Tap a point to see its run; use the filters above to narrow the runs.";
  await Promise.all(DATA.panels.map(drawPanel));
  listeners.push((shown) => VIEWS.forEach((view) => view.signal("mask", shown).signal("chosen", state.chosen).runAsync()));
}

/** Lift every brush: Vega keeps its selection in a data set of its own. */
function clearBrushes() {
  state.brushes = {};
  VIEWS.forEach((view) => { if (!COARSE) view.data("brush_store", []).signal("brush_x", []).signal("brush_y", []).runAsync(); });
}
