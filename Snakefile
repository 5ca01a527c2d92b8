# Which notebook runs on which session with which parameters, then the book.
#
#   snakemake -c2                                     the demo profile
#   snakemake -c2 --configfile config/smoke.yaml      another profile
#   snakemake -c2 -n                                  only say what would run, and why
#
# A run is out of date when the code it uses, its parameters or its inputs changed. Code means the notebook's code cells
# and the modules under src that it imports, without comments and docstrings, and the versions in requirements.lock: they
# enter as a digest in `params`, so editing a text reruns no notebook (the book takes the new text all the same).

import json
import os
import shlex
import sys
from pathlib import Path

sys.path.insert(0, str(Path(workflow.basedir, "workflow")))
import chapters
import run_lock
from chapters import NOTEBOOKS, Run
from snakemake_interface_common.exceptions import WorkflowError

if not workflow.configfiles:
    configfile: "config/demo.yaml"

CONFIG_FILE = os.path.relpath(workflow.configfiles[-1])
if workflow.is_main_process and not workflow.output_settings.dryrun:  # the Snakemake of a job is no main process
    run_lock.wait_for_lock(".snakemake/run.lock", CONFIG_FILE)
chapters.check_config(config, CONFIG_FILE)
SESSIONS_ROOT, OUT, BOOK = (os.path.normpath(config[key]) for key in ("sessions_root", "out_dir", "book_dir"))
SESSIONS, METHODS = config["sessions"], config["methods"]
TRAIN, LOCALIZE = SESSIONS[0], SESSIONS[1:]
RUNS = chapters.all_runs(config)
PARAMETERS = {run: chapters.run_parameters(config, run) for run in RUNS}  # a name that a notebook lacks ends here
DIGESTS = {chapter: chapters.chapter_digest(NOTEBOOKS / f"{chapter}.ipynb") for chapter in chapters.CHAPTERS}
TRANSLATION = chapters.translation(config)  # network and options of the generated images, those of chapter 05
RECIPES = (config["simulated"] or {}).get("sessions", {})
PYTHON, JUPYTER_BOOK = sys.executable, Path(sys.executable).with_name("jupyter-book")

# One job uses the threads it was given and no more, and threads that wait leave the processor to others.
# Figures go into the notebook, whatever the caller's environment says.
ENVIRONMENT = "env -u JPY_SESSION_NAME NUMBA_NUM_THREADS={threads} OMP_WAIT_POLICY=PASSIVE PYTHONHASHSEED=0 PYTHONUTF8=1 MPLBACKEND=module://matplotlib_inline.backend_inline "
# papermill writes to the log, since Snakemake deletes the outputs of a failed job, and a traceback with it.
PAPERMILL = ENVIRONMENT + (
    "{PYTHON:q} -m papermill {input.notebook:q} {log.notebook:q} --kernel python3 --no-progress-bar {params.arguments} "
    "> {log.text:q} 2>&1 && cp {log.notebook:q} {output.notebook:q} "
    "|| {{ tail -n 30 {log.text:q}; echo the failed notebook, with its traceback: {log.notebook:q}; exit 1; }}"
)


wildcard_constraints:
    session="|".join(SESSIONS),
    method="|".join(METHODS),


def session_made(session):
    """Name the file that says a session is there; a simulated one is made by its rule, a real one must be on disk."""
    if session in RECIPES:
        return f"{SESSIONS_ROOT}/{session}/session.json"
    stamps = f"{SESSIONS_ROOT}/{session}/radar.timestamps"
    if not Path(stamps).is_file():
        raise WorkflowError(f"{stamps} is missing, and {CONFIG_FILE} does not say how to make {session}; see data/README.md")
    return stamps


def recipe(session):
    """Give what a simulated session depends on: the settings common to all and its own."""
    return {**config["simulated"], "sessions": {session: RECIPES[session]}}


def executed(chapter, folder=f"{OUT}/notebooks"):
    """Name the executed notebook of a chapter, with wildcards where it runs more than once."""
    often = chapters.CHAPTERS[chapter]
    run = Run(chapter, "" if often == "once" else "{session}", "{method}" if often == "method" else "")
    return str(run.path(OUT)).replace(f"{OUT}/notebooks", folder, 1)


def logs(chapter):
    """Name the logs of a chapter: the notebook as far as it came, and what papermill said."""
    notebook = executed(chapter, f"{OUT}/logs")
    return {"notebook": notebook, "text": notebook.replace(".ipynb", ".log")}


def arguments(chapter):
    """Give the function from wildcards to papermill's arguments."""
    return lambda wildcards: chapters.papermill_arguments(
        PARAMETERS[Run(chapter, wildcards.get("session", ""), wildcards.get("method", ""))]
    )


def source(chapter):
    """Name a chapter's notebook; its date does not count, the digest of its code does."""
    return ancient(f"notebooks/{chapter}.ipynb")


def of_session(wildcards):
    """Name the file that says that the session of a job is there."""
    return session_made(wildcards.session)


def found(pattern):
    """List the files of the project that a pattern matches, without hidden ones."""
    return sorted(str(path) for path in Path().glob(pattern) if not path.name.startswith("."))


SHIPPED = found("data/weights/*.safetensors")  # networks that come with the book


# ---- what the chapters read and write ---------------------------------------------------------------------------

ALIGNMENT = OUT + "/alignment/{session}/alignment.csv"
PAIRS, CORRECTED = (OUT + "/" + folder + "/{session}/pairs.json" for folder in ("pairs", "pairs-corrected"))
GENERATED = OUT + "/fake/{session}/fake.json"
NETWORK, SUMMARY, MAPS = f"{OUT}/pix2pix/generator.safetensors", f"{OUT}/maps/summary.json", OUT + "/maps/{session}.npz"
TRUTH, METRICS = OUT + "/ground_truth/{session}.tum", OUT + "/localization/{session}/{method}/metrics.json"
ALL_MADE = [session_made(session) for session in SESSIONS]

# Rule: its chapter, its message, and the files that it reads and writes besides its notebook. 04 has a rule of its own.
STEPS = {
    "sessions": (
        "01_sessions",
        "sessions",
        {"sessions": ALL_MADE, "tables": found("data/paper/*.csv")},
        {},
    ),
    "alignment": ("02_alignment", "alignment, {wildcards.session}", {"session": of_session}, {"alignment": ALIGNMENT}),
    "ground_removal": (
        "03_ground_removal",
        "ground removal, {wildcards.session}",
        {"session": of_session, "alignment": ALIGNMENT},
        {"pairs": PAIRS, "corrected": CORRECTED},
    ),
    "real_vs_fake": (
        "05_real_vs_fake",
        "real against fake",
        {
            "pairs": expand(PAIRS, session=SESSIONS),
            "corrected": expand(CORRECTED, session=LOCALIZE),
            "fake": expand(GENERATED, session=SESSIONS),
            "weights": NETWORK,
            "shipped": SHIPPED,
        },
        {"similarity": expand(OUT + "/similarity/{session}.json", session=SESSIONS)},
    ),
    "ground_truth": (
        "06_ground_truth",
        "ground truth",
        {"sessions": ALL_MADE, "alignment": expand(ALIGNMENT, session=SESSIONS)},
        {"summary": SUMMARY, "maps": expand(MAPS, session=SESSIONS), "truth": expand(TRUTH, session=SESSIONS)},
    ),
    "localization": (
        "07_localization",
        "localization, {wildcards.session}, {wildcards.method}",
        {"fake": GENERATED, "corrected": CORRECTED, "summary": SUMMARY, "map": MAPS.format(session=TRAIN), "truth": TRUTH},
        {"metrics": METRICS},
    ),
    "results": (
        "08_results",
        "results",
        {
            "metrics": expand(METRICS, session=LOCALIZE, method=METHODS),
            "summary": SUMMARY,
            "tables": found("data/paper/*.csv"),
        },
        {},
    ),
    "oxford_route": (
        "11_oxford_route",
        "the real route",
        {"tables": found("data/paper/*.csv"), "measured": found("data/ablations/route_*.csv")},
        {},
    ),
    "real_pairs": ("09_real_pairs", "real pairs", {"shipped": SHIPPED}, {}),
    "robust_filter": (
        "12_robust_filter",
        "the robust filter",
        {"measured": found("data/ablations/route_*.csv")},
        {},
    ),
    "real_radar": ("10_real_radar", "real radar", {"weights": NETWORK, "shipped": SHIPPED}, {}),
    "ablations": (
        "13_ablations",
        "ablations",
        {
            "tables": found("data/ablations/*.csv"),
            "pairs": expand(PAIRS, session=SESSIONS),
            "weights": NETWORK,
            "shipped": SHIPPED,
            "cards": [str(Path(path).with_suffix(".json")) for path in SHIPPED],
        },
        {},
    ),
    "runtime": ("14_runtime", "runtime", {"measured": found("data/performance/*.json")}, {}),
    "simulator": ("15_simulator", "the simulator", {"session": session_made(TRAIN)}, {}),
}
def clear_images(folder, listing, code):
    """Write the command that removes the images of other code from a folder: a job goes on with those of a stopped run."""
    return (
        f'made={folder}; [ "$(cat "$made.code" 2>/dev/null)" = {code} ] '
        f"""|| ! grep -qs '"listing": "{listing}"' "$made/settings.json" """
        """|| find "$made" -maxdepth 2 -name '[0-9]*.png' -delete; """
        f'mkdir -p "$(dirname "$made")"; echo {code} > "$made.code"; '
    )


PAIRS_CODE = chapters.module_digest("rol.pairs")
BEFORE = {  # commands that come before papermill
    "ground_removal": lambda wildcards: "".join(
        clear_images(shlex.quote(f"{OUT}/{folder}/{wildcards.session}"), "pairs.json", PAIRS_CODE)
        for folder in ("pairs", "pairs-corrected")
    )
}
# The longest chapters, 04, 10 and 13, wait for sessions and pairs, so these come first. All others have 0; those with -1
# need no training, are needed by no other chapter, and fill gaps.
FIRST, NEXT = 3, 2
PRIORITIES = {"alignment": FIRST, "ground_removal": FIRST} | dict.fromkeys(
    ("real_pairs", "oxford_route", "robust_filter", "runtime", "simulator"), -1
)


rule book:
    input:
        notebooks=[run.path(OUT) for run in RUNS],
        sources=[f"notebooks/{chapter}.ipynb" for chapter in chapters.CHAPTERS],
        pages=[path for path in found("book/**/*") if Path(path).is_file()],
        modules=found("src/**/*.py"),
        stage=["workflow/stage_book.py", "workflow/toolbox_pages.py", "workflow/check.py"],
        reference=found("data/reference/*.json"),
    output:
        f"{BOOK}/_build/html/index.html",
    log:
        f"{OUT}/logs/book.log",
    params:
        config=json.dumps(config, sort_keys=True),
        repository=os.environ.get("ROL_REPOSITORY_URL", ""),
    message:
        "the book in {BOOK}"
    shell:
        "{PYTHON:q} workflow/stage_book.py {CONFIG_FILE:q} > {log:q} 2>&1 "
        "&& {JUPYTER_BOOK:q} build {BOOK:q} --all -W -n --keep-going >> {log:q} 2>&1 "
        "|| {{ grep -E 'WARNING|ERROR|Error' {log:q} || tail -n 30 {log:q}; echo the whole log: {log:q}; exit 1; }}"


rule chapters:
    input:
        [run.path(OUT) for run in RUNS],


rule simulated_session:
    output:
        SESSIONS_ROOT + "/{session}/session.json",
    log:
        SESSIONS_ROOT + "/{session}.log",
    params:
        recipe=lambda wildcards: json.dumps(recipe(wildcards.session), sort_keys=True),
        code=chapters.module_digest(f"{chapters.SIMULATOR}.__main__"),
        made=SESSIONS_ROOT + "/{session}",
    priority: FIRST
    message:
        "simulated session {wildcards.session}"
    shell:  # the writer goes on with what is there, which is right after a stop and wrong after a change of its code
        'made={params.made:q}; [ "$(cat "$made.code" 2>/dev/null)" = {params.code} ] '
        """|| ! grep -qs '"format":' "$made/settings.json" || rm -rf "$made"; """
        'echo {params.code} > "$made.code"; '
        + ENVIRONMENT + "{PYTHON:q} -m {chapters.SIMULATOR} {CONFIG_FILE:q} --session {wildcards.session:q} --out {SESSIONS_ROOT:q} "
        "> {log:q} 2>&1 || {{ tail -n 30 {log:q}; exit 1; }}"


for name, (chapter, message, reads, writes) in STEPS.items():

    rule:
        name:
            name
        input:
            notebook=source(chapter),
            **reads,
        output:
            notebook=executed(chapter),
            **writes,
        log:
            **logs(chapter),
        params:
            arguments=arguments(chapter),
            code=DIGESTS[chapter],
            before=BEFORE.get(name, ""),
        priority: PRIORITIES.get(name, 0)
        message:
            f"{chapter[:2]} {message}"
        shell:
            "{params.before}" + PAPERMILL


rule pix2pix:
    input:
        notebook=source("04_pix2pix"),
        pairs=PAIRS.format(session=TRAIN),
    output:
        notebook=executed("04_pix2pix"),
        weights=NETWORK,
    log:
        **logs("04_pix2pix"),
    params:
        arguments=arguments("04_pix2pix"),
        code=DIGESTS["04_pix2pix"],
        checkpoint=f"{OUT}/pix2pix/checkpoint",
    threads: 1  # a second one makes it hardly quicker, and has other chapters to run
    message:
        "04 pix2pix: training"
    shell:  # continues from the checkpoint of a stopped run; one of other code, parameters or pairs is set aside
        'kept={params.checkpoint:q}; run=$(echo {params.code} {params.arguments:q} | cat - {input.pairs:q} | cksum); '
        'if [ "$(cat "$kept/run.txt" 2>/dev/null)" != "$run" ]; then '
        'if [ -d "$kept" ]; then rm -rf "$kept-before"; mv "$kept" "$kept-before"; fi; '
        'mkdir -p "$kept"; echo "$run" > "$kept/run.txt"; fi; ' + PAPERMILL


rule generated_images:
    input:
        pairs=PAIRS,
        weights=TRANSLATION["weights"],
    output:
        GENERATED,
    log:
        OUT + "/logs/generated_images/{session}.log",
    params:
        pairs=OUT + "/pairs/{session}",
        out=OUT + "/fake/{session}",
        options=TRANSLATION["options"],
        code=chapters.script_digest("generate_images.py"),
    priority: NEXT
    message:
        "generated images, {wildcards.session}"
    shell:
        clear_images("{params.out:q}", "fake.json", "{params.code}")
        + ENVIRONMENT + "OMP_NUM_THREADS={threads} {PYTHON:q} workflow/generate_images.py {params.pairs:q} {input.weights:q} "
        "{params.out:q} --threads {threads} {params.options} > {log:q} 2>&1 || {{ tail -n 30 {log:q}; exit 1; }}"
