"""Writing of a study's report page as one HTML file that opens from disk, without server and
network."""

import json
from pathlib import Path

from ssm_study.durable import write_atomically
from ssm_study.refusal import BadRequest
from ssm_study.report.answers import question_answers
from ssm_study.report.page.data import page_data, page_texts, sort_for_page
from ssm_study.report.page.templates import chart_templates
from ssm_study.report.study_folder import StudyFolder

ASSETS = Path(__file__).parent / "assets"
SCRIPTS = tuple(
    f"{name}.js"
    for name in ("state", "shades", "charts", "plots", "table", "run", "compare", "lead", "main")
)  # in this order


def write_page(study_folder: Path, other_studies: tuple[Path, ...] = ()) -> Path:
    """Write the report page `report.html` of a study and return its path. Raises `BadRequest`
    without the extra `report` (Altair).

    With `other_studies`, one page shows all studies beside one another:
    `study_folder/report_with_OTHER.html`. The file carries data, style, scripts and the plotting
    library; its content policy forbids any request.
    """
    try:
        from jinja2 import Environment

        from ssm_study.report.page.charts import (
            EXPLORER,
            group_chart_specification,
            scatter_plot_contents,
            scatter_plot_specification,
            unplotted_answers,
        )
    except ImportError as error:
        remedy = "pip install 'ssm-study[report]'"
        raise BadRequest("report", "page", f"{error.name} is not installed", remedy) from error
    study = StudyFolder(folder=study_folder, others=other_studies)
    table = sort_for_page(study.table)
    answered = question_answers(table)
    data = page_data(study) | {
        "panels": scatter_plot_contents(table, answered),
        "explorer": scatter_plot_specification(EXPLORER, table),
        "groups": group_chart_specification(),
        "templates": chart_templates(table),
    }
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&":  # whatever the texts of a run contain, they end no <script> element
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    files = {name: read_asset(name) for name in ("page.css", *SCRIPTS)}
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    html = environment.from_string(read_asset("page.html")).render(
        **page_texts(study, table, unplotted_answers(table, answered)),
        style=files["page.css"],
        data=text,
        library=_read_charting_library(),
        script="\n".join(files[name] for name in SCRIPTS),
    )
    path = study_folder / (
        "_".join(["report", *(f"with_{other.resolve().name}" for other in other_studies)]) + ".html"
    )
    write_atomically(path, html.encode(), durable=False)
    return path


def read_asset(name: str) -> str:
    """Read a script, style sheet or template of the report page."""
    return (ASSETS / name).read_text(encoding="utf-8")


def _read_charting_library() -> str:
    """Read the JavaScript of Vega, Vega-Lite and vega-embed from the installed Python package."""
    import altair
    import vl_convert

    version = ".".join(altair.SCHEMA_VERSION.removeprefix("v").split(".")[:2])
    bundle: str = vl_convert.javascript_bundle(vl_version=version)  # type: ignore[call-arg]  # the stub has no default
    return bundle.replace("</script", "<\\/script")
