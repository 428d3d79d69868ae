// Wiring: the words above, the form, the failures and the provenance below.
function drawWords() {
  if (RUNS === 1) document.getElementById("filters-title").textContent = "Signals";
  document.getElementById("study").textContent = `Study ${DATA.study}`;
  document.getElementById("question").textContent = DATA.question;
  if (RUNS === 1) for (const id of ["compare", "filters", "count", "plots-hint", "beside"]) document.getElementById(id).hidden = true; // nothing to compare
  document.getElementById("swept").textContent = DATA.swept;
  document.getElementById("answers").append(...DATA.answers.map(({ question, sentences }) =>
    element("article", {}, element("h3", {}, question), ...sentences.map((text) => element("p", {}, text)))));
  document.getElementById("words").hidden = !DATA.answers.length;
}

function tally(word) {
  return (COLUMNS.verdict || []).filter((other) => other === word).length;
}

function drawForm() {
  document.getElementById("verdicts").append(...DATA.verdicts.filter(({ word }) => tally(word)).map(({ word, sentence }) => {
    const box = element("input", { type: "checkbox", checked: state.verdicts.has(word), value: word, onchange: (event) => {
      if (event.target.checked) state.verdicts.add(word); else state.verdicts.delete(word);
      changed();
    } });
    return element("label", { title: sentence }, box, marker(word), `${word} (${tally(word)})`);
  }));
  document.getElementById("selects").append(...DATA.parameters.map(select).filter(Boolean));
  document.getElementById("range-column").append(element("option", { value: "" }, "any column"),
    ...columnOptions());
}

function select(name) {
  const values = [...new Set(COLUMNS[name].map((_, i) => setting(name, i)).filter((value) => value !== null))];
  if (values.length > 30) return null; // the range filter serves those
  values.sort(inOrder);
  return element("label", {}, DATA.words[name].replace(/ \(.*/, ""),
    element("select", { "data-select": name, onchange: (event) => { state.selects[name] = event.target.value; changed(); } },
      element("option", { value: "" }, "any"), ...values.map((value) => element("option", { value: String(value), selected: state.selects[name] === String(value) }, printed(value)))));
}

function number(id) {
  const { value } = document.getElementById(id);
  return value === "" ? null : Number(value);
}

function listen() {
  const form = document.getElementById("filters");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => {
    Object.assign(state, { text: "", selects: {}, range: { column: "", low: null, high: null }, verdicts: new Set(DATA.verdicts.map((v) => v.word)) });
    clearBrushes();
    changed();
  });
  document.getElementById("text").addEventListener("input", (event) => { state.text = event.target.value; changed(); });
  for (const id of ["range-column", "range-low", "range-high"]) {
    document.getElementById(id).addEventListener("input", () => {
      state.range = { column: document.getElementById("range-column").value, low: number("range-low"), high: number("range-high") };
      changed();
    });
  }
  document.getElementById("all-columns").addEventListener("change", (event) => { state.allColumns = event.target.checked; changed(true); });
  document.getElementById("run-close").addEventListener("click", closeRun);
  document.getElementById("run-before").addEventListener("click", () => step(-1));
  document.getElementById("run-after").addEventListener("click", () => step(1));
  document.addEventListener("keydown", (event) => { if (event.key === "Escape" && state.chosen >= 0) closeRun(); });
}

function why(i, word) {
  if (word === "certified, not tried") return DATA.verdicts.find((v) => v.word === word).sentence;
  if (word === "certified, does not settle") return `${printed(COLUMNS.stable_count[i])} of ${printed(COLUMNS.initial_conditions[i])} starts settle`;
  return reasons(i).join(" ") || "no reason was recorded";
}

const NUMBER = /(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])/g;

/** One sentence for several that differ in their numbers alone: each number that varies becomes its range. */
function withRanges(sentences) {
  const numbers = sentences.map((text) => text.match(NUMBER).map(Number));
  let place = -1;
  return sentences[0].replace(NUMBER, (text) => {
    place += 1;
    const seen = numbers.map((found) => found[place]), low = Math.min(...seen), high = Math.max(...seen);
    return low === high ? text : `${low} to ${high}`;
  });
}

/** Runs that did not end well, grouped by reason: the same cause is told once. */
function drawFailures() {
  const groups = new Map();
  for (let i = 0; i < RUNS; i += 1) {
    const word = COLUMNS.verdict[i];
    if (["certified, settles", "certified, no faster than without control", "identified"].includes(word)) continue;
    const key = `${word}: ${why(i, word)}`.replace(NUMBER, "#");
    groups.set(key, [...(groups.get(key) || []), i]);
  }
  const box = document.getElementById("failures");
  document.getElementById("failed").hidden = !groups.size;
  const severity = ([key]) => ["failed", "certified", "not certified", "infeasible"].findIndex((word) => key.startsWith(word));
  const ordered = [...groups].sort((a, b) => severity(a) - severity(b) || a[0].localeCompare(b[0]));
  for (const [key, runs] of ordered.slice(0, 40)) {
    const said = runs.map((i) => `${COLUMNS.verdict[i]}: ${why(i, COLUMNS.verdict[i])}`), reason = key.includes("#") ? withRanges(said) : said[0];
    const buttons = runs.slice(0, 12).map((i) => element("li", {}, element("button", { type: "button", title: COLUMNS.run[i], onclick: () => choose(i) }, shortName(COLUMNS.run[i]))));
    const more = runs.length > 12 ? [element("li", {}, `and ${runs.length - 12} more`)] : [];
    box.append(element("details", {}, element("summary", {}, `${runs.length} × ${reason}`), element("ul", {}, ...buttons, ...more)));
  }
  if (ordered.length > 40) box.append(element("p", {}, `${ordered.length - 40} further reasons: filter the table by outcome to see them.`));
}

function drawProvenance() {
  document.getElementById("provenance").append(...DATA.provenance.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
  if (RUNS) document.getElementById("provenance").append(element("dt", {}, "to check the best run"), element("dd", {}, element("code", {}, `ssm-study verify results/${(/^\.\.\/([^/]+)/.exec(COLUMNS.run[0]) || [null, DATA.folder])[1]}/${partsOf(COLUMNS.run[0]).at(-1)}`)));
  document.getElementById("configuration").textContent = DATA.configuration || "No run left its configuration.";
}

/** Links to what stands below the first screen; the page's fragment keeps the reader's choices, so they only scroll. */
function drawContents() {
  const places = [...document.querySelectorAll("main section[id]")].filter(({ hidden }) => !hidden);
  document.getElementById("contents").append(...places.map((section) => element("a", { href: `#${section.id}`, onclick: (event) => {
    event.preventDefault();
    section.scrollIntoView();
    section.tabIndex = -1;
    section.focus({ preventScroll: true });
  } }, section.id === "compare" ? "Comparison" : section.querySelector("h2").textContent)));
}

/** Pictures of the run that the table has first; the section is hidden where it left none. */
function drawBestPictures() {
  const pictures = (RUNS && DATA.pictures[COLUMNS.run[0]]) || [];
  document.getElementById("pictures").hidden = !pictures.length;
  placePictures(document.getElementById("best-pictures"), pictures);
}

drawWords();
drawLead();
drawBestPictures();
readLink();
drawForm();
drawGroupForm();
listen();
drawFailures();
drawProvenance();
drawSideBySide();
drawContents();
document.getElementById("download").addEventListener("click", downloadTable);
listeners.unshift(drawTable);
listeners.push(keepInLink);
changed();
drawPlots().then(() => requestAnimationFrame(() => { document.body.dataset.ready = "yes"; })); // after the first table
