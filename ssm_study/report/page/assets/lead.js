// The first screen: the best run's responses beside the plant left alone, four numbers, and what they rest on.
const SVG = "http://www.w3.org/2000/svg";
const SMALL = { width: 300, height: 170, bottom: 26, top: 6, right: 4 };

function shape(tag, attributes, text) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

/** One panel of lines as plain SVG: the first screen must stand before Vega has drawn anything. */
function responses(title, rows, { step_s, band, goal, output }, [low, high]) {
  const { width, height, bottom, top, right } = SMALL;
  const far = Number((0.8 * Math.max(high - goal, goal - low)).toPrecision(1)), ticks = [goal - far, goal, goal + far].filter((v) => v >= low && v <= high).map((v) => [v, printed(Number(v.toPrecision(2)))]);
  const left = 8 + 6.5 * Math.max(...ticks.map(([, text]) => text.length));
  const end = (rows[0].length - 1) * step_s || 1, span = high - low || 1;
  const x = (t) => left + (t / end) * (width - left - right), y = (v) => top + ((high - v) / span) * (height - top - bottom);
  const svg = shape("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}: ${output} against time, ${rows.length} starts` });
  svg.append(shape("rect", { x: left, width: width - left - right, y: y(goal + band), height: Math.max(1, y(goal - band) - y(goal + band)), class: "band" }));
  for (const [value, text] of ticks) svg.append(shape("text", { x: left - 4, y: y(value) + 4, class: "tick end" }, text));
  for (const t of [0, end / 2, end]) svg.append(shape("text", { x: x(t), y: height - 12, class: t === end ? "tick end" : "tick" }, `${Number(t.toPrecision(2))}${t === end ? " s" : ""}`));
  const order = rows.map((row, n) => [row[0], n]).sort((a, b) => a[0] - b[0]).map(([, n]) => n);
  rows.forEach((row, n) => {
    const hue = 265 - (190 * order.indexOf(n)) / Math.max(1, rows.length - 1);
    const points = row.map((value, k) => `${x(k * step_s).toFixed(1)},${y(Math.min(Math.max(value, low), high)).toFixed(1)}`).join(" ");
    svg.append(shape("polyline", { points, fill: "none", stroke: `hsl(${hue} 70% ${DARK ? 62 : 40}%)`, "stroke-width": 1.4 }));
  });
  return element("figure", {}, element("figcaption", {}, title, element("span", { class: "note" }, output)), svg);
}

function bestResponses(loop) {
  const own = unpack(loop.y), alone = unpack(loop.alone), range = rangeOf([[...own, ...alone]], [loop.goal]);
  return [responses("Under control", own, loop, range), responses("Left alone, same starts", alone, loop, range)];
}

/** What all lines visit, at most as far again as the starts reach: one that diverges leaves the picture. */
function rangeOf(loops, goals) {
  const starts = loops.flat().map((row) => row[0]).concat(goals), low = Math.min(...starts), high = Math.max(...starts), span = high - low || 1;
  const seen = loops.flat(2), least = Math.max(seen.reduce((a, b) => Math.min(a, b), low), low - span), most = Math.min(seen.reduce((a, b) => Math.max(a, b), high), high + span);
  return [least - 0.1 * span, most + 0.1 * span];
}

/** What the loop of run i was closed on. */
function loopOn(i) {
  return { "identified model": "model", device: "device" }[(COLUMNS.loop_on || [])[i]] || "simulated plant";
}

/** The four numbers of run i; a number that the run has not is left out. */
function headline(i) {
  const value = (name) => (COLUMNS[name] ? COLUMNS[name][i] : null);
  const told = [], add = (number, words) => { if (number !== null) told.push([number, words]); };
  const both = value("controller_certified") && value("observer_certified");
  const ratio = value("settling_time_mean_s") / value("settling_time_open_loop_s");
  add(value("fit_test_percent") === null ? null : `${value("fit_test_percent").toFixed(1)} %`, "fit on the test record");
  const rate = value("controller_certified_rate") ?? value("rate_controller"), limit = value("controller_rate_limit");
  if (both && rate !== null) add(printed(Number(rate.toPrecision(2))), `certified rate${value("rate_controller") === null ? "" : `, designed for ${printed(Number(value("rate_controller").toPrecision(2)))}`}: distances shrink by ${(100 - 100 * Math.sqrt(1 - rate)).toPrecision(2)}\u00a0% a\u00a0sample`);
  else if (rate !== null) add(limit === null ? "none" : printed(Number(limit.toPrecision(3))), limit === null ? "certificate" : `largest rate that can be certified${value("rate_controller") === null ? "" : `; requested: ${printed(Number(value("rate_controller").toPrecision(3)))}`}`);
  add(value("stable_count") === null ? null : `${value("stable_count")} of ${value("initial_conditions")}`, `starts settle on the ${loopOn(i)}`);
  add(Number.isFinite(ratio) && ratio > 0 ? `${ratio.toFixed(2) === "1.00" ? besideOne(ratio) : ratio.toFixed(2)} ×` : null, "the uncontrolled settling time");
  return told;
}

const SUPPORT = { sound: "no check of the records speaks against the prediction", doubt: "the records leave a doubt", "cannot judge": "the records allow no judgement" };

/** What is proved, what is predicted, what was seen, and what the records say of it: one short line each. */
function evidence(i) {
  const value = (name) => (COLUMNS[name] ? COLUMNS[name][i] : null);
  const seconds = (name) => `${printed(value(name))}\u00a0s`;
  const { word, sentence } = DATA.verdicts.find((v) => v.word === COLUMNS.verdict[i]), lines = word === "certified, settles" ? [] : [["Outcome", [`${word}: ${sentence}.`, ...reasons(i).map((text) => `${text[0].toUpperCase()}${text.slice(1)}.`)].join(" ")]];
  const on = loopOn(i) === "model" ? "model" : "plant";
  if (value("controller_certified_rate") !== null) lines.push(["Proved of the model", `the controller contracts at rate ${printed(value("controller_certified_rate"))} per sample, the observer at ${printed(value("observer_certified_rate"))}${covered(value("coverage"))}.`]);
  if (value("predicted_stable") !== null) lines.push([`Predicted for the ${on}`, `${value("predicted_stable") ? `it stays stable${value("evidence") === "doubt" ? ", with doubts" : ""}` : "nothing; the loop may be unstable"}: ${decides(value("resolved_margin"), value("controller_radius"))}.`]);
  else if (value("evidence") === "cannot judge") lines.push([`Predicted for the ${on}`, "nothing: the records allow no judgement."]);
  if (value("settling_time_mean_s") !== null) lines.push([`Seen on the ${loopOn(i)}`, `it settles in ${seconds("settling_time_mean_s")} on average${value("settling_time_open_loop_s") === null ? "" : `, uncontrolled in ${seconds("settling_time_open_loop_s")}`}${value("stable_count_pi") === null ? "" : `; a PI tuned from the same model in ${seconds("settling_time_pi_s")}, ${value("stable_count_pi")} of ${value("initial_conditions")} starts`}.`]);
  const told = (value("evidence_reasons") || "").split(/ (?=(?:note|doubt|cannot judge): )/).filter(Boolean), isNote = (reason) => reason.startsWith("note: ");
  const first = told.filter((reason) => !isNote(reason)).map((reason) => reason.replace(/^[a-z ]+: /, "")), notes = told.filter(isNote).map((note) => `N${note.slice(1)}`);
  if (value("evidence")) lines.push([`Evidence: ${value("evidence")}`, [`${SUPPORT[value("evidence")]}.`, ...first].join(" "), notes]);
  return lines;
}

/** What the proof says of the plant; below one it covers nothing. */
function covered(coverage) {
  if (coverage === null) return "";
  return coverage < 1 ? "; the model error that the records show is not covered" : `; it covers a model error ${(Math.floor(100 * coverage) / 100).toFixed(2)} times as large as the records show, at every frequency`;
}

/** The two numbers that a prediction rests on, each with its bound. */
function decides(margin, radius) {
  return [margin === null ? "" : `the stability margin is ${besideOne(margin)} (above 1 is needed)`, radius === null ? "" : `the spectral radius of the controller ${margin === null ? "is " : ""}${besideOne(radius)} (below 1 is needed)`].filter(Boolean).join(" and ");
}

/** What the first run of the table is, and the rule by which it is the best as far as it applied. */
function whyBest() {
  if (RUNS === 1) return "Run: ";
  if (COLUMNS.verdict[0] !== "certified, settles") return "No run is certified and settles; the nearest: ";
  return `Best run (the fastest of those that are certified${COLUMNS.predicted_stable && COLUMNS.predicted_stable[0] ? ", predicted to be stable" : ""} and settle): `;
}

function drawLead() {
  const box = document.getElementById("lead");
  if (!RUNS) return;
  const found = DATA.trajectories[COLUMNS.run[0]], loop = found && found.loop;
  const numbers = headline(0).map(([number, words]) => element("div", { class: "number" }, element("strong", {}, number), element("span", {}, words)));
  const lines = evidence(0).map(([label, text, notes = []]) => element("li", { class: /^(?:Outcome|Evidence: (?:doubt|cannot))/.test(label) ? "warn" : "" }, element("strong", {}, label), text[0].toUpperCase() + text.slice(1),
    ...(notes.length ? [element("details", {}, element("summary", {}, `${notes.length} ${notes.length > 1 ? "notes" : "note"}`), ...notes.map((note) => element("p", {}, note)))] : [])));
  box.append(
    element("p", {}, whyBest(), element("button", { type: "button", class: "link", onclick: () => choose(0) }, partsOf(COLUMNS.run[0]).join("-")),
      DATA.parameters.length ? `. Its settings: ${DATA.parameters.map((name) => `${DATA.words[name].replace(/[ ,]*[(,ρ].*/, "").toLowerCase()} ${printed(setting(name, 0))}`).join(", ")}.` : ""),
    element("div", { class: "lead" }, ...(loop ? [element("div", { class: "responses" }, ...bestResponses(loop))] : []),
      element("div", { class: "numbers" }, ...numbers)), element("ul", { class: "evidence" }, ...lines));
}
