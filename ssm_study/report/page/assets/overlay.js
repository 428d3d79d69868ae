// Chosen runs in one axis: their free runs on one record, their loops from one start; and all runs as parallel coordinates.
const CYCLE = ["#0072b2", "#d55e00", "#009e73", "#e69f00", "#56b4e9", "#cc79a7"];

function signalOver(values, step_s, more) {
  return { x: values.map((_, k) => Number((k * step_s).toPrecision(6))), y: values, ...more };
}

/** One picture of the free runs, if the chosen runs have one validation record; and one of the loops, from the same start. */
function overlayPictures(runs) {
  const found = runs.map((i) => ({ name: shortName(COLUMNS.run[i]), ...DATA.trajectories[COLUMNS.run[i]] }));
  const pictures = [], records = found.filter(({ validation }) => validation), loops = found.filter(({ loop }) => loop);
  if (records.length > 1 && records.every(({ validation }) => validation.y.steps === records[0].validation.y.steps)) {
    const { y, step_s, output } = records[0].validation, models = records.map(({ validation }) => unpack(validation.model)[0]), measured = unpack(y)[0];
    const line = (values, k) => signalOver(values, step_s, { name: records[k].name, mark: "line", colour: CYCLE[k % CYCLE.length] });
    pictures.push({ name: "free-runs", title: "Free runs on the validation record (beginning)", panels: [
      { x: "Time (s)", y: output, series: [signalOver(measured, step_s, { name: "measured", mark: "dots", colour: "#6b6b6b" }), ...models.map(line)] },
      { x: "Time (s)", y: "Error", rules: [{ y: 0 }], series: models.map((values, k) => ({ ...line(values.map((value, t) => measured[t] - value), k), name: "" })) }] });
  }
  if (loops.length > 1) {
    const starts = loops.map(({ loop }) => unpack(loop.y)), far = starts[0].map((row) => Math.abs(row[0] - loops[0].loop.goal)), worst = far.indexOf(Math.max(...far));
    const series = starts.map((rows, k) => signalOver(rows[Math.min(worst, rows.length - 1)], loops[k].loop.step_s, { name: loops[k].name, mark: "line", colour: CYCLE[k % CYCLE.length] }));
    const { goal, band, output } = loops[0].loop, end = Math.max(...series.map(({ x }) => x.at(-1)));
    pictures.push({ name: "loops", title: "Closed loops from the farthest start", panels: [{ x: "Time (s)", y: output, series,
      bands: [{ x: [0, end], low: [goal - band, goal - band], high: [goal + band, goal + band], colour: "#d9d9d9", name: "settling band" }] }] });
  }
  return pictures;
}

/** A line per run over its settings and results, each scaled to its own range; the ends of the ranges stand below. */
function parallelSpec(names) {
  const ranges = new Map(names.map((name) => { const values = known(COLUMNS[name]); return [name, [Math.min(...values), Math.max(...values)]]; }));
  const at = (name, value) => { const [low, high] = ranges.get(name); return high > low ? (value - low) / (high - low) : 0.5; };
  const rows = rowsFor([]).flatMap((row) => names.filter((name) => typeof COLUMNS[name][row.i] === "number").map((name) => ({ ...row, key: DATA.words[name].replace(/ \(.*/, ""), share: at(name, COLUMNS[name][row.i]), value: COLUMNS[name][row.i] })));
  const labels = names.flatMap((name) => ranges.get(name).map((value, high) => ({ key: DATA.words[name].replace(/ \(.*/, ""), share: high, text: printed(Number(value.toPrecision(3))) })));
  const x = { field: "key", type: "nominal", sort: null, title: null, axis: { labelAngle: -20, labelLimit: 150, grid: true, domain: false } }, y = { field: "share", type: "quantitative", axis: null };
  const colour = { field: "verdict", type: "nominal", legend: null, scale: { domain: DATA.verdicts.map(({ word }) => word), range: DATA.verdicts.map(({ colour: own }) => own) } };
  return { height: 230, layer: [
    { data: { values: rows }, mark: { type: "line", strokeWidth: 1.3, opacity: RUNS > 200 ? 0.15 : 0.6 }, encoding: { x, y, detail: { field: "i" }, color: colour } },
    { data: { values: labels }, mark: { type: "text", dx: 6, align: "left", fontSize: 10, color: "#1a1a1a" }, encoding: { x, y, text: { field: "text" } } }] };
}

const MOST_PARALLEL = 500; // runs, beyond which lines are no picture
/** Puts the parallel coordinates of what was swept and of four results at the end of the plots. */
function placeParallel() {
  const names = [...DATA.parameters, "fit_test_percent", "resolved_margin", "settling_time_mean_s", "stable_fraction"].filter((name) => name !== "study" && COLUMNS[name] && isNumeric(name) && new Set(known(COLUMNS[name])).size > 1);
  if (names.length < 3 || RUNS > MOST_PARALLEL) return;
  const chart = element("div", { class: "chart" }), said = `All runs over ${names.map((name) => DATA.words[name]).join(", ")}: one line per run`;
  chart.spec = () => ({ description: said, ...parallelSpec(names) });
  NEAR.observe(chart);
  const note = element("span", { class: "note" }, "Each axis from its smallest to its largest value; colours as in the plots.");
  document.getElementById("plots").append(element("figure", { class: "wide" }, element("figcaption", {}, "All settings and results at once", note), chart));
}
