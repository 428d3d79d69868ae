// One run: what it is, why it ended as it did, and its trajectories.
let openedFrom = null;
const REASONS = ["infeasible_reason", "uncertified_reason", "error_message"]; // said at the top, not once more below

function choose(i) {
  if (document.getElementById("run").hidden) openedFrom = document.activeElement;
  state.chosen = i;
  dock(true);
  drawRun(i);
  markChosen();
  document.getElementById("run-title").focus({ preventScroll: true });
}

function closeRun() {
  const row = document.querySelector(`tr[data-run="${state.chosen}"] button`);
  const back = openedFrom && openedFrom.isConnected ? openedFrom : row;
  state.chosen = -1;
  dock(false);
  if (back) back.focus({ preventScroll: true });
  markChosen();
}

/** Table and plots follow the run that is open; which runs are shown stays as it is. */
function markChosen() {
  for (const row of document.querySelectorAll("#body tr"))
    row.classList.toggle("chosen", Number(row.dataset.run) === state.chosen);
  allStale();
}

/** Beside the page where there is room, over its foot on a phone; the plots take what width is left. */
function dock(open) {
  if (document.getElementById("run").hidden === !open) return;
  document.getElementById("run").hidden = !open;
  document.body.classList.toggle("with-run", open);
}

function step(by) {
  const order = state.order || [];
  const next = order[order.indexOf(state.chosen) + by];
  if (next !== undefined) choose(next);
}

function drawRun(i) {
  const name = COLUMNS.run[i];
  const { word, sentence } = DATA.verdicts.find((v) => v.word === COLUMNS.verdict[i]);
  document.getElementById("run-title").textContent = printed(name);
  const content = document.getElementById("run-content");
  const said = REASONS.map((key) => COLUMNS[key] && COLUMNS[key][i]);
  content.replaceChildren(
    element("p", {}, `${word}: ${sentence}.`),
    ...said.filter(Boolean).map((text) => element("p", { class: "reason" }, text)),
    ...trajectoryFigures(i),
  );
  const pictures = element("div", { class: "pictures" });
  placePictures(pictures, DATA.pictures[name] || []);
  content.append(pictures);
  const compared = DATA.comparisons[name] || {};
  if (compared.table) content.insertAdjacentHTML("beforeend", compared.table); // escaped by Python
  if (compared.chart) {
    const { title, note, spec } = compared.chart;
    content.append(figureOf(title, [chartOf(spec)], note));
  }
  content.append(...factsOf(i));
}

function trajectoryFigures(i) {
  const { loop, validation } = DATA.trajectories[COLUMNS.run[i]] || {};
  const figures = [];
  if (loop) {
    const range = rangeOf([i]);
    figures.push(
      figureOf("Under control", [responsesOf(loop, loop.y, "Under control", range)]),
      figureOf("Without control, same starts", [responsesOf(loop, loop.alone, "Without control", range)]),
      figureOf("Input of the controlled runs", [
        linesOf("responses", "Input", loop.input, { rows: inputRows(loop) }),
      ]),
    );
  }
  if (validation && !DATA.pictures[COLUMNS.run[i]]) {
    const rows = ["y", "model"].flatMap((key) =>
      overTime(unpack(validation[key]), validation.step_s, key === "y" ? "measured" : "model"),
    );
    const title = "Validation record (beginning)";
    figures.push(figureOf(title, [linesOf("signals", title, validation.output, { rows })]));
  }
  if (figures.length) return figures;
  const where = `${DATA.folder}/${COLUMNS.run[i]}/closed_loop.mcap`;
  return [
    element(
      "p",
      { class: "quiet" },
      `No trajectories here; if the run left any they are in ${where}.`,
    ),
  ];
}

const VARIES = new Map(); // of each column, once it was asked

/** Whether the runs differ in a column. */
function varies(name) {
  if (!VARIES.has(name))
    VARIES.set(
      name,
      COLUMNS[name].some((value) => value !== COLUMNS[name][0]),
    );
  return VARIES.get(name);
}

/** What is known of the run: first what is not the same in all runs, settings marked; the rest behind a fold. */
function factsOf(i) {
  const recorded = Object.keys(COLUMNS).filter((name) => COLUMNS[name][i] !== null);
  const named = recorded.filter((name) => DATA.known_columns.includes(name) && !REASONS.includes(name));
  const differ = named.filter((name) => RUNS === 1 || varies(name));
  const folded = (title, names) =>
    names.length
      ? [
          element(
            "details",
            {},
            element("summary", {}, `${title} (${names.length})`),
            factList(names, i),
          ),
        ]
      : [];
  return [
    factList(differ, i),
    ...folded(
      "The same in all runs",
      named.filter((name) => !differ.includes(name)),
    ),
    ...folded(
      "Everything else in the record",
      recorded.filter((name) => !named.includes(name)),
    ),
  ];
}

function factList(names, i) {
  return element(
    "dl",
    {},
    ...names.flatMap((name) => {
      const set = RUNS > 1 && DATA.parameters.includes(name) ? "set" : "";
      return [
        element("dt", { class: set }, DATA.words[name]),
        element("dd", { class: set }, cellOf(name, i)),
      ];
    }),
  );
}
