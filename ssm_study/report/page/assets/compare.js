// Comparing: runs grouped by a setting with mean and spread over the rest, and chosen runs side by side.
const METRICS = [
  "settling_time_mean_s",
  "fit_test_percent",
  "stable_fraction",
  "resolved_margin",
  "rate_controller",
  "controller_gain_norm",
  "input_peak_v",
];
const MOST_GROUPS = 40;

const known = (values) => values.filter((value) => typeof value === "number");
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

function spread(values) {
  const middle = mean(values);
  const squares = values.reduce((sum, value) => sum + (value - middle) ** 2, 0);
  return Math.sqrt(squares / (values.length - 1));
}

/** A setting as it was requested: for a rate that `auto` chose, `auto`. */
function setting(name, i) {
  const chosen =
    name.startsWith("rate_") && COLUMNS.rates_chosen && String(COLUMNS.rates_chosen[i]);
  return chosen && chosen.includes(name.slice(5)) ? "auto" : COLUMNS[name][i];
}

function groupOf(i) {
  return state.group.by.map((name) => printed(setting(name, i))).join(" · ");
}

/** `{label: [run indices]}` of the runs in `mask`, in the order of the settings' values. */
function grouped(mask) {
  const { by } = state.group;
  const first = (i, j) =>
    by.reduce((sign, name) => sign || inOrder(setting(name, i), setting(name, j)), 0);
  const runs = [...mask.keys()].filter((i) => mask[i]).sort(first);
  return Map.groupBy(runs, groupOf);
}

/** Up to three values as they are; of more `0.1883 ± 0.0014`: the spread to two digits, the mean as far as the spread reaches; rounding alone is no spread. */
function meanAndSpread(values) {
  if (!values.length) return "–";
  const different = [...new Set(values)].sort((a, b) => a - b);
  if (values.length < 4) return different.map((value) => printed(Number(value.toPrecision(3)))).join(", ");
  const middle = mean(values);
  const short = printed(Number(middle.toPrecision(3)));
  const wide = spread(values);
  if (wide <= 1e-9 * Math.abs(middle)) return `${short} ± 0`;
  const places = 1 - Math.floor(Math.log10(wide));
  if (places < 0 || places > 6) return `${short} ± ${printed(Number(wide.toPrecision(2)))}`;
  return `${middle.toFixed(places)} ± ${wide.toFixed(places)}`;
}

/** A table of texts; the first cell of each row is its heading. */
function tableOf(label, heads, rows, foot = []) {
  const rowOf = ([title, ...cells]) =>
    element(
      "tr",
      {},
      element("th", { scope: "row" }, title),
      ...cells.map((cell) => element("td", {}, cell)),
    );
  return element(
    "div",
    { class: "scroll compared", tabindex: "0", role: "region", "aria-label": label },
    element(
      "table",
      {},
      element(
        "thead",
        {},
        element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head))),
      ),
      element("tbody", {}, ...rows.map(rowOf)),
      element("tfoot", {}, ...foot.map(rowOf)),
    ),
  );
}

/** Means over the shown runs of each group; the strips above draw themselves with the plots. */
function drawGroups(shown, news) {
  const settings = JSON.stringify(state.group);
  if (!news && drawGroups.settings === settings) return; // sorting concerns the table alone
  if (drawGroups.settings !== settings) drawStrips();
  drawGroups.settings = settings;
  const { by } = state.group;
  const groups = [...grouped(shown)];
  const metrics = METRICS.filter(
    (name) => !by.includes(name) && COLUMNS[name] && known(COLUMNS[name]).length,
  );
  const rowOf = ([label, runs]) => [
    label,
    String(runs.length),
    ...metrics.map((name) => {
      const values = known(runs.map((i) => COLUMNS[name][i]));
      return meanAndSpread(name === "fit_test_percent" ? [...new Set(values)] : values);
    }),
  ];
  const more =
    groups.length > MOST_GROUPS ? `; ${groups.length - MOST_GROUPS} more groups are not shown` : "";
  const caption = `Mean ± standard deviation over the runs of each group, or up to three values as they are; fits count each model once${more}`;
  const all = groups.length > 1 ? [rowOf(["All", groups.flatMap(([, runs]) => runs)])] : [];
  const heads = [
    by.map((name) => DATA.words[name]).join(" · "),
    "Runs",
    ...metrics.map((name) => DATA.words[name]),
  ];
  document
    .getElementById("groups")
    .replaceChildren(
      element("p", { class: "quiet" }, `${caption}.`),
      tableOf(caption, heads, groups.slice(0, MOST_GROUPS).map(rowOf), all),
    );
}

/** A strip per group, brushed and coloured with the plots; logarithmic where one value would crush the rest. */
function drawStrips() {
  const { by, metric } = state.group;
  const spec = structuredClone(DATA.groups);
  const { x, y } = spec.layer.at(-1).encoding;
  const values = known(COLUMNS[metric]);
  const log = Math.min(...values) > 0 && Math.max(...values) > 20 * Math.min(...values);
  x.title = DATA.words[metric];
  if (log) x.scale = { type: "log", nice: false, padding: 12 };
  y.scale = { domain: [...grouped(Array(RUNS).fill(1)).keys()].slice(0, MOST_GROUPS) };
  spec.height = 26 * y.scale.domain.length;
  spec.description = `${DATA.words[metric]} by group, one point per run, a bar at the mean`;
  for (const layer of spec.layer) Object.assign(layer.encoding.x.scale, x.scale);
  const rows = rowsFor([]).map((row) => ({
    ...row,
    value: COLUMNS[metric][row.i],
    label: groupOf(row.i),
  }));
  const usable = rows.filter(
    ({ value, label }) => typeof value === "number" && y.scale.domain.includes(label),
  );
  const names = by.map((name) => DATA.words[name]).join(" · ");
  const note = `Rows: ${names}. One point per run, a bar at the mean, a ring around the best run${log ? "; logarithmic axis" : ""}.`;
  document
    .getElementById("groups-title")
    .replaceChildren(DATA.words[metric], element("span", { class: "note" }, note));
  const columnOf = (field) => (field === "value" ? metric : field);
  return embed(document.getElementById("strips"), spec, { rows: usable }, STRIPS, columnOf);
}

function drawGroupForm() {
  if (RUNS < 2) return;
  const few = (name) => new Set(COLUMNS[name].map((_, i) => setting(name, i))).size <= MOST_GROUPS;
  const names = DATA.parameters.filter(few);
  const metrics = METRICS.filter((name) => COLUMNS[name] && known(COLUMNS[name]).length);
  document.getElementById("compare").hidden = !names.length || !metrics.length;
  if (!names.length || !metrics.length) return;
  const linked = [state.group.by].flat().filter((name) => names.includes(name));
  const first = ["study", ...names.filter((name) => name !== "seed"), "seed"].find((name) =>
    names.includes(name),
  );
  state.group = {
    by: linked.length ? linked : [first],
    metric: metrics.includes(state.group.metric) ? state.group.metric : metrics[0],
  };
  const tick = (name) => (event) => {
    const by = names.filter((other) =>
      other === name ? event.target.checked : state.group.by.includes(other),
    );
    if (by.length) state.group.by = by;
    else event.target.checked = true; // one at least
    changed(true);
  };
  const box = (name) =>
    element(
      "label",
      {},
      element("input", {
        type: "checkbox",
        value: name,
        checked: state.group.by.includes(name),
        onchange: tick(name),
      }),
      shortWord(name),
    );
  const select = element(
    "select",
    {
      "aria-label": "What is compared",
      onchange: (event) => {
        state.group.metric = event.target.value;
        changed(true);
      },
    },
    ...metrics.map((name) =>
      element("option", { value: name, selected: name === state.group.metric }, DATA.words[name]),
    ),
  );
  document
    .getElementById("group-form")
    .append(
      element("label", {}, "Compare", select),
      element("fieldset", {}, element("legend", {}, "by"), ...names.map(box)),
    );
  listeners.push(drawGroups);
}

/** A run by the settings in which the runs differ, or by its name if they do not. */
function titleOf(i) {
  return (
    DATA.parameters.map((name) => `${shortWord(name)} ${printed(setting(name, i))}`).join(", ") ||
    shortName(COLUMNS.run[i])
  );
}

/** Chosen runs side by side: in one axis, each alone, then the settings and numbers in which they differ. */
function drawSideBySide() {
  const box = document.getElementById("side");
  const runs = [...state.picked].sort((i, j) => i - j);
  if (!box) return;
  if (runs.length < 2) {
    box.replaceChildren(
      element(
        "p",
        { class: "quiet" },
        "Tick two or more runs in the table to see them side by side.",
      ),
    );
    return;
  }
  const names = runs.map(titleOf);
  const loops = runs.filter(loopOf);
  const range = loops.length ? rangeOf(loops) : null;
  const pictures = loops.map((i) =>
    figureOf(titleOf(i), [
      responsesOf(loopOf(i), loopOf(i).y, "Under control", range),
    ]),
  );
  const differ = [...new Set([...DATA.first, ...Object.keys(COLUMNS)])].filter(
    (name) =>
      name !== "run" &&
      COLUMNS[name] &&
      DATA.known_columns.includes(name) &&
      new Set(runs.map((i) => printed(COLUMNS[name][i]))).size > 1,
  );
  const rows = differ.map((name) => [
    DATA.words[name],
    ...runs.map((i) => printed(COLUMNS[name][i])),
  ]);
  box.replaceChildren(
    element("div", { class: "pictures" }, ...overlayFigures(runs)),
    element("div", { class: "responses" }, ...pictures),
    tableOf("Chosen runs, what differs", ["", ...names], rows),
  );
}

/** Free runs, if the chosen runs have one validation record, their errors, and the loops from the farthest start. */
function overlayFigures(runs) {
  const figures = [];
  const records = runs
    .map((i) => ({ i, ...(DATA.trajectories[COLUMNS.run[i]] || {}).validation }))
    .filter(({ y }) => y);
  if (records.length > 1 && records.every(({ y }) => y.steps === records[0].y.steps)) {
    const [measured] = unpack(records[0].y);
    const { step_s, output } = records[0];
    const runOf = ({ i, model }, signal) =>
      overTime([signal(unpack(model)[0])], step_s, titleOf(i));
    const models = records.flatMap((record) => runOf(record, (values) => values));
    const errors = records.flatMap((record) =>
      runOf(record, (values) => values.map((value, k) => measured[k] - value)),
    );
    const same = records.every(({ model }) => model.steps === records[0].model.steps);
    const title = `Free runs on the validation record (beginning)${same ? ": one model, the curves coincide" : ""}`;
    figures.push(
      figureOf(
        title,
        [
          linesOf("signals", title, output, {
            rows: [...overTime([measured], step_s, "measured"), ...models],
          }),
          linesOf("signals", "Error of the free runs", `Error, ${output}`, { rows: errors }),
        ],
        "",
        { "data-overlay": "free-runs" },
      ),
    );
  } else if (records.length > 1) {
    const words = "The chosen runs have different validation records: their free runs are not overlaid.";
    figures.push(element("p", { class: "quiet" }, words));
  }
  const loops = runs.filter(loopOf);
  const without = runs.filter((i) => !loops.includes(i)).map(titleOf);
  if (without.length)
    figures.push(element("p", { class: "quiet" }, `No closed loop to show: ${without.join(", ")}.`));
  if (loops.length > 1) {
    const signals = loops.map((i) => unpack(loopOf(i).y));
    const far = signals[0].map((values) => Math.abs(values[0] - loopOf(loops[0]).goal));
    const worst = far.indexOf(Math.max(...far));
    const rowsOf = (key) =>
      loops.flatMap((i) => {
        const cases = unpack(loopOf(i)[key]);
        return overTime([cases[worst] || cases[0]], loopOf(i).step_s, titleOf(i));
      });
    const title = "Closed loops from the farthest start, and their inputs";
    const { output, input } = loopOf(loops[0]);
    figures.push(
      figureOf(
        title,
        [
          linesOf("signals", title, output, { rows: rowsOf("y"), band: bandOf(loopOf(loops[0])) }),
          linesOf("signals", "Inputs from the farthest start", input, { rows: rowsOf("u") }),
        ],
        "",
        { "data-overlay": "loops" },
      ),
    );
  }
  return figures;
}

/** The shown runs, all columns, as a file; a text that begins like a formula gets an apostrophe before it. */
function downloadTable() {
  const names = Object.keys(COLUMNS);
  const cell = (value) => {
    const text = value == null ? "" : String(value);
    const safe = typeof value === "string" && /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const lines = [
    names.join(","),
    ...state.order.map((i) => names.map((name) => cell(COLUMNS[name][i])).join(",")),
  ];
  const file = new Blob([`${lines.join("\n")}\n`], { type: "text/csv" });
  const link = element("a", { href: URL.createObjectURL(file), download: `${DATA.study}.csv` });
  link.click();
  URL.revokeObjectURL(link.href);
}

/** The choices of the reader as the page's fragment, so that a link shows what its sender saw. */
function keepInLink() {
  const { text, selects, range, sort, group } = state;
  const choices = {
    text,
    selects,
    range: range.column ? range : undefined,
    sort: sort.column ? sort : undefined,
    hidden: DATA.verdicts.map((v) => v.word).filter((word) => !state.verdicts.has(word)),
    group,
    picked: [...state.picked].map((i) => COLUMNS.run[i]),
  };
  history.replaceState(null, "", `#${encodeURIComponent(JSON.stringify(choices))}`);
}

function readLink() {
  try {
    const choices = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    for (const key of ["text", "selects", "range", "sort", "group"])
      if (choices[key]) state[key] = choices[key];
    (choices.hidden || []).forEach((word) => state.verdicts.delete(word));
    state.picked = new Set(
      (choices.picked || []).map((name) => COLUMNS.run.indexOf(name)).filter((i) => i >= 0),
    );
  } catch {
    /* an ordinary address, or one that was cut */
  }
}
