// The best run's responses beside the uncontrolled plant, moved by a swept setting, and one start played.
function drawLead() {
  const loop = RUNS && loopOf(0);
  if (!loop) return;
  const swept = DATA.slider;
  const range = rangeOf(swept ? swept.runs.filter(loopOf) : [0]);
  const controlled = responsesOf(loop, loop.y, "Under control", range);
  const player = playerOf(loop, range);
  const applied = inputsOf(loop, inputRange(swept ? swept.runs.filter(loopOf) : [0]));
  document
    .getElementById("responses")
    .append(
      figureOf("Under control", [
        controlled,
        ...(swept ? [sliderOf(swept, [controlled, player], applied)] : []),
      ]),
      figureOf("Without control, same starts", [responsesOf(loop, loop.alone, "Without control", range)]),
      figureOf("Input of the controlled runs", [applied]),
      figureOf("One start, played", [player, playButton(player)]),
    );
}

function inputsOf(loop, range) {
  const rows = inputRows(loop);
  return linesOf("responses", "Input of the controlled runs", loop.input, { rows }, range);
}

/** All inputs of these runs, with a little room. */
function inputRange(runs) {
  const values = runs.flatMap((i) => unpack(loopOf(i).u).flat());
  const low = values.reduce((a, b) => Math.min(a, b));
  const high = values.reduce((a, b) => Math.max(a, b));
  const room = 0.05 * (high - low) || 1;
  return [low - room, high + room];
}

function inputRows(loop) {
  return overTime(unpack(loop.u), loop.step_s, "", unpack(loop.y));
}

/** Moves the ten responses and their inputs through the runs of a sweep. */
function sliderOf({ title, runs, values, notes }, charts, applied) {
  const said = element("output", {});
  const slide = element("input", {
    type: "range",
    min: 0,
    max: runs.length - 1,
    step: 1,
    "aria-label": title,
  });
  const show = () => {
    const i = runs[slide.value];
    const loop = loopOf(i); // an infeasible run has none
    const rows = loop ? overTime(unpack(loop.y), loop.step_s) : [];
    said.textContent = `${title} ${printed(values[slide.value])}: ${notes[slide.value]} (run ${shortName(COLUMNS.run[i])}${i ? "; cards and pictures stay those of the best run" : ""})`;
    slide.setAttribute("aria-valuetext", said.textContent);
    for (const { dataset } of [...charts, applied]) dataset.empty = loop ? "" : `No response: ${notes[slide.value]}`;
    for (const { view } of charts) if (view) view.data("rows", rows).runAsync();
    if (applied.view) applied.view.data("rows", loop ? inputRows(loop) : []).runAsync();
  };
  slide.value = Math.max(0, runs.indexOf(0));
  slide.addEventListener("input", show);
  for (const chart of [...charts, applied]) chart.addEventListener("drawn", show);
  show();
  return element("label", { class: "slider" }, title, slide, said);
}

function playerOf(loop, range) {
  const signals = unpack(loop.y);
  const end = Number(((signals[0].length - 1) * loop.step_s).toPrecision(6));
  const player = linesOf(
    "played",
    "One start, played",
    loop.output,
    {
      rows: overTime(signals, loop.step_s),
      band: bandOf(loop),
    },
    range,
  );
  const far = signals.map((values) => Math.abs(values[0] - loop.goal));
  const [start, moment] = player.spec.params;
  start.value = far.indexOf(Math.max(...far)) + 1;
  start.bind = { ...start.bind, min: 1, max: signals.length, step: 1 };
  moment.value = end;
  moment.bind = { ...moment.bind, max: end, step: loop.step_s };
  player.end = end;
  return player;
}

const PLAYED_S = 4; // seconds in which a start is played, however fast the plant is

function playButton(player) {
  const button = element("button", { type: "button", "aria-pressed": "false" }, "Play");
  let playing = false;
  const label = (now) => {
    playing = now;
    button.textContent = now ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(now));
  };
  button.addEventListener("click", () => {
    if (playing || !player.view || !player.view.data("rows").length) return label(false);
    label(true);
    const from = player.view.signal("moment") >= player.end ? 0 : player.view.signal("moment");
    const begun = performance.now() - (1000 * PLAYED_S * from) / player.end;
    const advance = async (now) => {
      if (!playing) return;
      const moment = Math.min(player.end, ((now - begun) / 1000 / PLAYED_S) * player.end);
      const shown = Number(Math.max(0, moment).toPrecision(3)); // it stands beside the slider
      await player.view.signal("moment", shown).runAsync();
      if (moment < player.end) requestAnimationFrame(advance);
      else label(false);
    };
    requestAnimationFrame(advance);
    return undefined;
  });
  return button;
}
