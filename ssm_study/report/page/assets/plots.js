// The plots: drawn by Vega, told which runs are shown and chosen; a brush in one filters all.
const COARSE = matchMedia("(pointer: coarse)").matches; // a finger scrolls: there a drag must not brush
const VIEWS = [];
const STRIPS = DATA.panels.length + 1; // the number of the groups' plot, brushed along one axis
const WIDTHS = []; // of the container each plot was last fitted into
const STALE = new Set(); // plots that do not show the present choice yet
const VISIBLE = new Set();
const SEEN = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries)
      VISIBLE[isIntersecting ? "add" : "delete"](Number(target.dataset.view));
    refresh();
  },
  { rootMargin: "100px" },
);
const CYCLE = ["#0072b2", "#d55e00", "#009e73", "#e69f00", "#56b4e9", "#cc79a7"];

/** What a point under the pointer says: written when it is asked for, not for every point beforehand. */
function tooltipOf(columnOf) {
  return (datum, sanitize) => {
    const numbers = Object.keys(datum).filter(
      (name) => typeof datum[name] === "number" && name !== "i",
    );
    const lines = [
      ["Run", shortName(datum.run)],
      ["Outcome", datum.verdict],
      ...numbers.map((name) => [DATA.words[columnOf(name)], printed(datum[name])]),
    ];
    const row = ([key, value]) =>
      `<tr><td class="key">${sanitize(key)}</td><td class="value">${sanitize(value)}</td></tr>`;
    return `<table><tbody>${lines.map(row).join("")}</tbody></table>`;
  };
}

function rowsFor(fields) {
  return Array.from({ length: RUNS }, (_, i) => {
    const row = {
      i,
      run: COLUMNS.run[i],
      verdict: COLUMNS.verdict[i],
      colour: state.colour ? printed(setting(state.colour, i)) : "",
    };
    for (const name of fields) row[name] = COLUMNS[name][i];
    return row;
  });
}

function withoutBrush(spec) {
  const copy = structuredClone(spec);
  const strip = (part) => {
    if (part.params) part.params = part.params.filter((param) => param.name !== "brush");
  };
  strip(copy);
  (copy.layer || []).forEach(strip);
  return copy;
}

const DRAWS = []; // what draws each plot again

/** The points in the colours of a setting instead of the outcome, whose shapes stay. Numbers go from dark to light, which
 * every eye and a grey print tell apart; few names have a colour each. */
function coloured(spec, rows = []) {
  const name = state.colour,
    copy = structuredClone(spec);
  if (!name) return copy;
  const settings = [...new Set(COLUMNS[name].map((_, i) => setting(name, i)))].sort(inOrder);
  const values = settings.map(printed);
  const few = values.length <= CYCLE.length && settings.some((value) => typeof value !== "number");
  const scale = few
    ? { domain: values, range: CYCLE.slice(0, values.length) }
    : { domain: values, scheme: { name: "viridis", extent: [0, 0.9] } };
  const legend = { orient: "top", title: shortWord(name), columns: 6, symbolType: "circle" };
  if (rows.length) legend.values = values.filter((value) => rows.some((row) => row.colour === value));
  copy.layer.at(-1).encoding.color = {
    field: "colour",
    type: few ? "nominal" : "ordinal",
    scale,
    legend,
  };
  return copy;
}

/** What the points are coloured by: any setting of few values, by default what was swept; or the outcome, which their shapes say too. */
function placeColourMenu() {
  const names = DATA.parameters.filter((name) => new Set(COLUMNS[name]).size <= 40);
  state.colour = names.find((name) => name !== "seed") || names[0] || "";
  if (!names.length) return;
  const recolour = async (event) => {
    state.colour = event.target.value;
    for (const draw of DRAWS) {
      await draw();
      await pause();
    }
    allStale();
  };
  const option = (name, words) =>
    element("option", { value: name, selected: name === state.colour }, words);
  const menu = element(
    "select",
    { id: "colour-by", onchange: recolour },
    option("", "outcome"),
    ...names.map((name) => option(name, shortWord(name))),
  );
  document.getElementById("selects").append(element("label", {}, "Colour by", menu));
}

/** One plot; `columnOf` maps a field of the rows to the column it holds (the explorer's are just across and up). */
async function embed(chart, spec, { rows, ticks = [] }, number, columnOf = (field) => field) {
  const painted = coloured(spec, rows);
  const own = COARSE ? withoutBrush(painted) : painted;
  if (VIEWS[number]) VIEWS[number].finalize();
  own.datasets = { ...own.datasets, runs: rows, ticks }; // beside the one-row set of a dashed line
  const { view } = await vegaEmbed(chart, shaded(own), {
    ...EMBED,
    tooltip: { ...EMBED.tooltip, formatTooltip: tooltipOf(columnOf) },
  });
  const menu = chart.querySelector("summary");
  if (menu) menu.setAttribute("aria-label", "Save this plot");
  if (!COARSE) {
    view.addSignalListener("brush", (_, value) => {
      const ranges = Object.entries(value || {}).filter(([, range]) => range.length === 2);
      state.brushes[number] = Object.fromEntries(
        ranges.map(([field, range]) => [columnOf(field), range]),
      );
      changed();
    });
  }
  view.addEventListener("click", (_, item) => {
    if (item && item.datum && item.datum.i !== undefined) choose(item.datum.i);
  });
  VIEWS[number] = view;
  WIDTHS[number] = view.container().clientWidth;
  chart.dataset.view = number;
  SEEN.observe(chart);
}

/** Puts the figure in its place and returns what draws it: the places must be there before a plot fits into one. */
function placePanel(panel, number) {
  const chart = element("div", { class: "chart" }),
    note = element("span", { class: "note" }, panel.note),
    sentences = panel.sentences.map((text) => element("span", { class: "answer" }, text));
  document
    .getElementById("plots")
    .append(element("figure", {}, element("figcaption", {}, panel.question, ...sentences, note), chart));
  const known = (fields) =>
    rowsFor(fields).filter((row) => fields.every((name) => typeof row[name] === "number"));
  const ticks = panel.tick
    ? new Map(
        known([panel.x, panel.tick]).map((row) => [`${row[panel.x]} ${row[panel.tick]}`, row]),
      )
    : new Map();
  return () =>
    embed(
      chart,
      panel.spec,
      { rows: known([panel.x, panel.y]), ticks: [...ticks.values()] },
      number,
    );
}

/** Any column against any other: the plot nobody thought of. */
function placeExplorer() {
  const number = DATA.panels.length,
    names = columnOptions().flatMap((group) => [...group.children].map((option) => option.value));
  if (names.length < 2) return () => {};
  const start = {
    across: DATA.parameters.find((name) => names.includes(name)) || names[0],
    up: names.includes("fit_test_percent") ? "fit_test_percent" : names[1],
  };
  const chart = element("div", { class: "chart" });
  const draw = () => {
    if (VIEWS[number]) VIEWS[number].finalize();
    delete state.brushes[number];
    const spec = structuredClone(DATA.explorer),
      points = spec.layer[spec.layer.length - 1].encoding;
    points.x.title = DATA.words[start.across];
    points.y.title = DATA.words[start.up];
    spec.description = `${DATA.words[start.up]} against ${DATA.words[start.across]}, one point per run`;
    const rows = rowsFor([]).map((row) => ({
      ...row,
      across: COLUMNS[start.across][row.i],
      up: COLUMNS[start.up][row.i],
    }));
    const known = rows.filter(
      (row) => typeof row.across === "number" && typeof row.up === "number",
    );
    for (const [axis, name] of [
      ["x", "across"],
      ["y", "up"],
    ])
      if (known.every((row) => Number.isInteger(row[name]))) points[axis].axis = { tickMinStep: 1 };
    return embed(chart, spec, { rows: known }, number, (field) => start[field]).then(() =>
      changed(true),
    );
  };
  const choice = (axis) =>
    element(
      "select",
      {
        "aria-label": `Column ${axis}`,
        "data-axis": axis,
        onchange: (event) => {
          start[axis] = event.target.value;
          draw();
        },
      },
      ...columnOptions(start[axis]),
    );
  document
    .getElementById("plots")
    .append(
      element(
        "figure",
        {},
        element("figcaption", {}, choice("up"), " against ", choice("across")),
        chart,
      ),
    );
  return draw;
}

/** All settings and results at once, at the end of the plots. */
function placeParallel() {
  const template = DATA.templates.parallel;
  if (!template) return;
  const chart = chartOf(template);
  const rows = () => rowsFor(template.usermeta.fields).filter(({ i }) => !state.shown || state.shown[i]);
  const paint = () => {
    const spec = structuredClone(chart.spec);
    if (state.colour) spec.layer[0].encoding.color = coloured(DATA.explorer).layer.at(-1).encoding.color;
    chart.spec = { ...spec, datasets: { rows: rows() } };
  };
  paint();
  DRAWS.push(() => {
    paint();
    WAITING.add(chart);
    return drawChart(chart);
  });
  listeners.push((_, news) => news && chart.view && chart.view.data("rows", rows()).runAsync());
  const note = "One line per run that is shown; each axis from its smallest to its largest value.";
  document
    .getElementById("plots")
    .append(figureOf("All settings and results at once", [chart], note, { class: "wide" }));
}

async function drawPlots() {
  if (RUNS < 2) return;
  if (COARSE)
    document.getElementById("plots-hint").textContent =
      "Tap a point to see its run; use the filters above to narrow the runs. The ring marks the best run.";
  placeColourMenu();
  for (const draw of [...DATA.panels.map(placePanel), placeExplorer()]) {
    await draw();
    DRAWS.push(draw);
    await pause();
  }
  if (state.group.metric) DRAWS.push(drawStrips);
  placeParallel();
  listeners.push((_, news) => news && allStale()); // sorting and paging concern the table alone
}

function allStale() {
  VIEWS.forEach((_, number) => STALE.add(number));
  refresh();
}

let refreshing = false;

/** Bring the plots in sight up to date, one at a time, so that a drag over thousands of runs never waits for all. */
async function refresh() {
  if (refreshing) return;
  refreshing = true;
  await new Promise(requestAnimationFrame); // what was clicked is on the screen before the plots are measured
  await pause();
  for (let next; (next = [...STALE].find((number) => VISIBLE.has(number))) !== undefined; ) {
    STALE.delete(next);
    const view = VIEWS[next],
      width = view.container().clientWidth;
    if (width && WIDTHS[next] !== width) view.width(width); // what it fits into, not what the axes leave of it
    WIDTHS[next] = width;
    await view.signal("mask", state.shown).signal("chosen", state.chosen).runAsync();
    await pause();
  }
  refreshing = false;
}

/** Lift every brush: Vega keeps its selection in a data set of its own. */
function clearBrushes() {
  state.brushes = {};
  if (COARSE) return;
  VIEWS.forEach((view, number) => {
    view.data("brush_store", []).signal("brush_x", []);
    if (number !== STRIPS) view.signal("brush_y", []);
    view.runAsync();
  });
}
