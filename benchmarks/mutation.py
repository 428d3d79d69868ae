"""Seeded faults in the certificate code, and the share the tests catch: `python
benchmarks/mutation.py`.

Cosmic Ray (an environment of its own: `pip install cosmic-ray`) lists every single fault of
`FAULTS` in the modules of a group; a sample drawn with `SEED` is planted, one at a time, in a copy
of the committed tree, and the group's tests run on it, first failure out, without the shape
checker. A run that takes more than `LIMIT_CPU_S` of processor time counts as caught (a loop that no
longer ends). `--folder DIR` holds the copies and a socket: start `mutation_server.py DIR/server`
first; with `HYPOTHESIS_PROFILE=few` in its environment for a first pass, without for the survivors'
second (`--again`), so that only the whole test decides that a fault survives. `--cosmic-ray` is the
tool's folder, `--groups a,b` restricts, `--minutes` stops a group (a second call goes on).

`--table DIR` runs in place of the group's tests those of all that execute the planted line,
cheapest first: `mutation_table.py` makes the table, `mutation_lines.py` reads it. Writes
`results/reference/mutation/faults.csv`, one row per planted fault, and `survivors.diff`.

The tests that verify a run share one, made before any fault is planted.
"""

import argparse
import hashlib
import json
import re
import sqlite3
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

from common import REFERENCE, ROOT, write
from mutation_groups import GROUPS, Group

FOLDER = REFERENCE / "mutation"
COLUMNS = ("group", "module", "line", "fault", "occurrence", "outcome")
SEED = 20261121
LIMIT_CPU_S = 180  # twice what the longest group takes without a fault
LIMIT_S = 1200
# Type errors in disguise (`x | y` for `x + y`) are left out: any test catches them, so they would
# only flatter.
FAULTS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)"
    r"|ReplaceComparisonOperator_(Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Lt_Gt|LtE_GtE|Gt_Lt|GtE_LtE|Eq_NotEq|NotEq_Eq|Is_IsNot"
    r"|IsNot_Is)|ReplaceUnaryOperator_Delete_(USub|Not)|AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue"
    r"|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceBreakWithContinue|ReplaceContinueWithBreak|ExceptionReplacer"
    r"|NumberReplacer|ZeroIterationForLoop)$"
)

NUMBER = re.compile(r"\b\d[\d_]*(\.\d+)?(e[+-]?\d+)?\b")


def among(group: Group, modules: list[str]) -> Group:
    """The group with those of its modules alone, or of its folders' modules; with all of them if
    none is named."""
    chosen = tuple(
        one
        for one in modules
        if any(one == own or one.startswith(f"{own}/") for own in group.modules)
    )
    return replace(group, modules=chosen if modules else group.modules)


def plant(name: str, group: Group, setup: argparse.Namespace) -> None:
    """Go on with the group's session for so many minutes; draw the faults alone for none."""
    folder = setup.folder
    session = folder / f"{name}.sqlite"
    config = folder / f"{name}.toml"
    tree = folder / name
    tool = setup.cosmic_ray / "cosmic-ray"
    fresh_copy(tree)
    (folder / "temporary").mkdir(exist_ok=True)  # shared/data is where the records are looked for
    by_line = setup.table is not None
    command = json.dumps((lines_command if by_line else group_command)(group, tree, setup))
    modules = json.dumps([f"ssm_study/{module}" for module in group.modules])
    config.write_text(
        f"[cosmic-ray]\nmodule-path = {modules}\ntimeout = {LIMIT_S}.0\nexcluded-modules = []\n"
        f'test-command = {command}\n[cosmic-ray.distributor]\nname = "local"\n'
    )
    if not session.exists():
        subprocess.run([tool, "baseline", config], cwd=tree, check=True)
        lister = Path(__file__).with_name("mutation_session.py")
        python = setup.cosmic_ray / "python"
        list_ = [python, lister, config, session, FAULTS.pattern]
        subprocess.run(list_, cwd=tree, check=True)
        planted = round(setup.share * group.planted) if setup.planted is None else setup.planted
        sample(session, tree, planted, setup.seed)
    if setup.minutes:
        exec_ = ["timeout", str(int(60 * setup.minutes)), tool, "exec", config, session]
        subprocess.run(exec_, cwd=tree, check=False)


def group_command(group: Group, tree: Path, setup: argparse.Namespace) -> str:
    """Command that runs the group's tests on the tree."""
    server = Path(__file__).with_name("mutation_server.py")
    base = setup.folder / "temporary" / tree.name
    options = f"-p no:xdist -p no:randomly -o addopts= --basetemp={base} -q -x"
    return (
        f"python3 -S {server} {setup.folder / 'server'} {LIMIT_CPU_S} {tree} {options}"
        f" {group.tests}"
    )


def lines_command(_: Group, tree: Path, setup: argparse.Namespace) -> str:
    """Command that runs the tests that execute the line planted in the tree."""
    chosen = Path(__file__).with_name("mutation_lines.py")
    socket = setup.folder / "server"
    return f"python3 -S {chosen} {socket} {setup.table} {tree} {setup.folder / 'temporary'}"


def again(session: Path) -> None:
    """Forget the survivors' outcomes, so that they are planted again: after tests were written for
    them."""
    with sqlite3.connect(session) as base:
        base.execute("delete from work_results where test_outcome = 'SURVIVED'")


def fresh_copy(tree: Path) -> None:
    tree.mkdir(parents=True, exist_ok=True)
    archive = subprocess.run(
        ["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True
    ).stdout
    subprocess.run(["tar", "x", "-C", tree], input=archive, check=True)


def sample(session: Path, tree: Path, planted: int, seed: int) -> None:
    """Keep the session's faults that come first in an order drawn with `seed`; none in a
    dataclass's own decorator.

    A fault's place in that order hangs on its own line alone, so the draw outlives changes
    elsewhere.
    """
    with sqlite3.connect(session) as base:
        query = (
            "select job_id, module_path, operator_name, start_pos_row, start_pos_col from "
            "mutation_specs"
        )
        specs = list(base.execute(f"{query} order by module_path, operator_name, occurrence"))
        lines = {
            path: (tree / path).read_text().splitlines() for path in {spec[1] for spec in specs}
        }
        place = {}
        seen = Counter[tuple[str, ...]]()
        for job, path, operator, row, column in specs:
            line = lines[path][row - 1].strip()
            if FAULTS.match(operator) and not line.startswith("@"):
                fault = path, operator, line, str(column)
                seen[fault] += 1
                place[job] = hashlib.sha256(repr((seed, fault, seen[fault])).encode()).hexdigest()
        kept = set(sorted(place, key=place.__getitem__)[:planted])
        for table in ("mutation_specs", "work_items"):
            base.executemany(
                f"delete from {table} where job_id = ?",
                [(s[0],) for s in specs if s[0] not in kept],
            )
    print(f"{session.stem}: {len(kept)} of {len(place)} faults planted", flush=True)


def planted_faults(session: Path) -> list[tuple[dict[str, object], str]]:
    query = (
        "select module_path, start_pos_row, operator_name, occurrence, test_outcome, diff "
        "from mutation_specs"
        " join work_results using (job_id) where diff is not null"
        " order by module_path, start_pos_row, operator_name, occurrence"
    )
    with sqlite3.connect(session) as base:
        found = list(base.execute(query))
    # without a diff the tool itself raised: nothing was planted
    outcomes = {"KILLED": "caught", "SURVIVED": "survived"}
    rows = []
    for module, line, fault, occurrence, said, diff in found:
        if not same_numbers(diff):
            values = (session.stem, module, line, fault[5:], occurrence, outcomes.get(said, said))
            rows.append((dict(zip(COLUMNS, values, strict=True)), diff))
    return rows


def same_numbers(diff: str) -> bool:
    """Whether nothing was planted: `1e150` plus one is `1e150`."""
    lines = [
        line for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")
    ]
    removed, added = (
        [NUMBER.sub(_value, line[1:]) for line in lines if line[0] == sign] for sign in "-+"
    )
    return removed == added


def _value(number: re.Match[str]) -> str:
    return repr(float(number[0].replace("_", "")))


def report(folder: Path, name_of: str) -> None:
    rows = [
        row
        for name in GROUPS
        if (folder / f"{name}.sqlite").exists()
        for row in planted_faults(folder / f"{name}.sqlite")
    ]
    write(FOLDER / f"{name_of}.csv", [row for row, _ in rows], COLUMNS)
    survivors = [diff for row, diff in rows if row["outcome"] == "survived"]
    (FOLDER / ("survivors.diff" if name_of == "faults" else f"{name_of}.diff")).write_text(
        "\n".join(survivors) + "\n"
    )
    for name in GROUPS:
        said = [row["outcome"] for row, _ in rows if row["group"] == name]
        print(f"{name}: {said.count('caught')} of {len(said)} caught", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("/tmp/mutation"))
    parser.add_argument("--cosmic-ray", type=Path, default=Path(sys.executable).parent)
    parser.add_argument("--groups", default=",".join(GROUPS))
    parser.add_argument("--again", action="store_true", help="plant the survivors again")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument(
        "--modules",
        default="",
        help="of these groups, these modules alone: robustness/return_to_rest.py,...",
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help="another draw: written to fresh.csv and fresh.diff"
    )
    parser.add_argument("--name", help="of the two files, in place of faults or fresh")
    parser.add_argument("--share", type=float, default=1.0, help="of each group's faults")
    parser.add_argument("--planted", type=int, help="faults in each group, in place of a share")
    parser.add_argument(
        "--table", type=Path, help="run the tests that execute the line: see mutation_table.py"
    )
    arguments = parser.parse_args()
    for name in filter(None, arguments.groups.split(",")):
        group = among(GROUPS[name], list(filter(None, arguments.modules.split(","))))
        if arguments.again:
            again(arguments.folder / f"{name}.sqlite")
        if group.modules:
            plant(name, group, arguments)
    report(arguments.folder, arguments.name or ("faults" if arguments.seed == SEED else "fresh"))


if __name__ == "__main__":
    main()
