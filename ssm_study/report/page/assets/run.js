// One run: what it is, why it ended as it did, and its trajectories.
let openedFrom = null;

function choose(i) {
  if (document.getElementById("run").hidden) openedFrom = document.activeElement;
  state.chosen = i;
  dock(true);
  drawRun(i);
  changed(true);
  document.getElementById("run-title").focus({ preventScroll: true });
}

function closeRun() {
  const back = openedFrom && openedFrom.isConnected ? openedFrom : document.querySelector(`tr[data-run="${state.chosen}"] button`);
  state.chosen = -1;
  dock(false);
  if (back) back.focus({ preventScroll: true });
  changed(true);
}

/** Beside the page where there is room, over its foot on a phone; the plots take what width is left. */
function dock(open) {
  if (document.getElementById("run").hidden === !open) return;
  document.getElementById("run").hidden = !open;
  document.body.classList.toggle("with-run", open);
  allStale();
}

function step(by) {
  const order = state.order || [];
  const next = order[order.indexOf(state.chosen) + by];
  if (next !== undefined) choose(next);
}

function drawRun(i) {
  const name = COLUMNS.run[i], word = COLUMNS.verdict[i];
  const verdict = DATA.verdicts.find((v) => v.word === word);
  document.getElementById("run-title").textContent = printed(name);
  const content = document.getElementById("run-content");
  content.replaceChildren(element("p", {}, `${word}: ${verdict.sentence}.`), ...reasons(i).map((text) => element("p", { class: "reason" }, text)));
  const found = DATA.trajectories[name], charts = [];
  if (found) charts.push(...trajectoryCharts(content, DATA.pictures[name] ? { loop: found.loop } : found));
  else content.append(element("p", { class: "quiet" }, `No trajectories here; if the run left any they are in ${DATA.folder}/${name}/closed_loop.mcap.`));
  const pictures = element("div", { class: "pictures" });
  placePictures(pictures, DATA.pictures[name] || []);
  content.append(pictures);
  const compared = DATA.comparisons[name];
  if (compared && compared.controller) content.append(controllersTable(compared));
  if (compared && compared.design) charts.push(designsChart(content, compared));
  const known = Object.keys(COLUMNS).filter((column) => COLUMNS[column][i] !== null);
  const named = known.filter((column) => DATA.known_columns.includes(column)), rest = known.filter((column) => !named.includes(column));
  content.append(facts(named, i), element("details", {}, element("summary", {}, "Everything else in the record"), facts(rest, i)));
  drawOneByOne(charts, i);
}

/** Each chart in a task of its own, so that the page stays alive; none once another run is looked at. */
async function drawOneByOne(charts, i) {
  for (const draw of charts) {
    await pause();
    if (state.chosen !== i) return;
    await draw();
  }
}

function reasons(i) {
  return ["infeasible_reason", "uncertified_reason", "error_message"].filter((name) => COLUMNS[name] && COLUMNS[name][i]).map((name) => COLUMNS[name][i]);
}

function facts(names, i) {
  return element("dl", {}, ...names.flatMap((name) => [element("dt", {}, DATA.words[name]), element("dd", {}, cellOf(name, i))]));
}

function unpack({ step, rows, steps }) {
  const bytes = Uint8Array.from(atob(steps), (c) => c.charCodeAt(0));
  const values = new Int16Array(bytes.buffer), length = values.length / rows;
  return Array.from({ length: rows }, (_, r) => Array.from(values.subarray(r * length, (r + 1) * length), (v) => v * step));
}

function lines(packed, step_s, kind) {
  return unpack(packed).flatMap((values, n) => values.map((value, k) => ({ t: k * step_s, value, case: n, kind })));
}

// Labels stand under their ticks and apart: neighbours must not read as one number ("0.550.60").
const LOOK = { font: "system-ui, sans-serif", view: { stroke: null }, axis: { gridColor: "#e6e6e6", titleFontWeight: "normal", labelFlush: false, labelSeparation: 8 } };

/** Puts a figure in its place and returns what draws it from its specification, made when it is asked for. */
function placeChart(content, [title, note], description, spec) {
  const chart = element("div", { class: "chart" });
  content.append(element("figure", {}, element("figcaption", {}, title, ...(note ? [element("span", { class: "note" }, note)] : [])), chart));
  const frame = { $schema: "https://vega.github.io/schema/vega-lite/v6.json", width: "container", height: 150, description, config: LOOK };
  return () => vegaEmbed(chart, shaded({ ...frame, ...spec() }), { ...EMBED, actions: false });
}

function chartOf(content, title, rows, { y, kinds, band, goal = 0, held = false }) {
  const colour = kinds ? { field: "kind", type: "nominal", title: null, scale: { domain: kinds, range: ["#6b6b6b", "#0072b2"] }, legend: { orient: "top" } }
    : { field: "case", type: "ordinal", legend: null, scale: { scheme: "viridis" } };
  const line = { mark: { type: "line", strokeWidth: 1.3, interpolate: held ? "step-after" : "linear" }, encoding: {
    x: { field: "t", type: "quantitative", title: "Time (s)" }, y: { field: "value", type: "quantitative", title: y }, color: colour,
    detail: { field: "case" } } };
  const layer = band ? [{ mark: { type: "rect", color: "#d9d9d9" }, encoding: { y: { datum: goal - band }, y2: { datum: goal + band } } }, line] : [line];
  return placeChart(content, [title], `${title}: ${y} against time`, () => ({ data: { values: rows() }, layer }));
}

function trajectoryCharts(content, { loop, validation }, responses = true) {
  const charts = [];
  if (loop) {
    const speeds = { y: loop.output, band: loop.band, goal: loop.goal };
    if (responses) charts.push(chartOf(content, "Under control", () => lines(loop.y, loop.step_s), speeds));
    if (responses) charts.push(chartOf(content, "Left alone, same starts", () => lines(loop.alone, loop.step_s), speeds));
    charts.push(chartOf(content, "Input of the controlled runs", () => lines(loop.u, loop.step_s), { y: loop.input, held: true }));
  }
  if (validation) {
    const rows = () => [...lines(validation.y, validation.step_s, "measured"), ...lines(validation.model, validation.step_s, "model")];
    charts.push(chartOf(content, "Validation record (beginning)", rows, { y: validation.output, kinds: ["measured", "model"] }));
  }
  return charts;
}
