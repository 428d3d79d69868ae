// Wiring: the filters, the links, and what draws first.
function tally(word) {
  return (COLUMNS.verdict || []).filter((other) => other === word).length;
}

function drawForm() {
  document.getElementById("verdicts").append(
    ...DATA.verdicts
      .filter(({ word }) => tally(word))
      .map(({ word, sentence }) => {
        const box = element("input", {
          type: "checkbox",
          checked: state.verdicts.has(word),
          value: word,
          onchange: (event) => {
            if (event.target.checked) state.verdicts.add(word);
            else state.verdicts.delete(word);
            changed();
          },
        });
        return element("label", { title: sentence }, box, marker(word), `${word} (${tally(word)})`);
      }),
  );
  document.getElementById("selects").append(...DATA.parameters.map(select).filter(Boolean));
  document
    .getElementById("range-column")
    .append(element("option", { value: "" }, "any column"), ...columnOptions());
}

function select(name) {
  const values = [
    ...new Set(COLUMNS[name].map((_, i) => setting(name, i)).filter((value) => value !== null)),
  ];
  if (values.length > 30) return null; // the range filter serves those
  values.sort(inOrder);
  return element(
    "label",
    {},
    shortWord(name),
    element(
      "select",
      {
        "data-select": name,
        onchange: (event) => {
          state.selects[name] = event.target.value;
          changed();
        },
      },
      element("option", { value: "" }, "any"),
      ...values.map((value) =>
        element(
          "option",
          { value: String(value), selected: state.selects[name] === String(value) },
          printed(value),
        ),
      ),
    ),
  );
}

function number(id) {
  const { value } = document.getElementById(id);
  return value === "" ? null : Number(value);
}

function listenToFilters() {
  const form = document.getElementById("filters");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => {
    Object.assign(state, {
      text: "",
      selects: {},
      range: { column: "", low: null, high: null },
      verdicts: new Set(DATA.verdicts.map((v) => v.word)),
    });
    clearBrushes();
    changed();
  });
  document.getElementById("text").addEventListener("input", (event) => {
    state.text = event.target.value;
    changed();
  });
  for (const id of ["range-column", "range-low", "range-high"]) {
    document.getElementById(id).addEventListener("input", () => {
      state.range = {
        column: document.getElementById("range-column").value,
        low: number("range-low"),
        high: number("range-high"),
      };
      changed();
    });
  }
}

function listen() {
  if (RUNS > 1) listenToFilters();
  document.querySelector("main").addEventListener("click", ({ target }) => {
    if (target.matches("button[data-run]")) choose(Number(target.dataset.run));
  });
  for (const button of document.querySelectorAll("main button[data-run]")) {
    button.title = COLUMNS.run[button.dataset.run];
    button.textContent = shortName(button.title);
  }
  document.getElementById("all-columns").addEventListener("change", (event) => {
    state.allColumns = event.target.checked;
    changed(true);
  });
  document.getElementById("run-close").addEventListener("click", closeRun);
  document.getElementById("run-before").addEventListener("click", () => step(-1));
  document.getElementById("run-after").addEventListener("click", () => step(1));
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && state.chosen >= 0) closeRun();
  });
}

/** Links to what stands below the first screen; the page's fragment keeps the reader's choices, so they only scroll. */
function drawContents() {
  const places = [...document.querySelectorAll("main section[id]")].filter(({ hidden }) => !hidden);
  document.getElementById("contents").append(
    ...places.map((section) =>
      element(
        "a",
        {
          href: `#${section.id}`,
          onclick: (event) => {
            event.preventDefault();
            section.scrollIntoView();
            section.tabIndex = -1;
            section.focus({ preventScroll: true });
          },
        },
        section.id === "compare" ? "Comparison" : section.querySelector("h2").textContent,
      ),
    ),
  );
}

/** Pictures of the run that the table has first; the section is hidden where it left none. */
function drawBestPictures() {
  const pictures = (RUNS && DATA.pictures[COLUMNS.run[0]]) || [];
  document.getElementById("pictures").hidden = !pictures.length;
  placePictures(document.getElementById("best-pictures"), pictures);
}

drawLead();
drawBestPictures();
readLink();
if (RUNS > 1) drawForm();
listen();
drawSideBySide();
drawContents();
document.getElementById("download").addEventListener("click", downloadTable);
listeners.unshift(drawTable);
listeners.push(keepInLink);
changed();
drawGroupForm();
drawPlots().then(() =>
  requestAnimationFrame(() => {
    document.body.dataset.ready = "yes";
    drawRest();
  }),
); // after the first table
