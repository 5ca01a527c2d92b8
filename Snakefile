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
SHIPPED = [str(path) for path in sorted(Path("data/weights").glob("[!.]*.safetensors"))]  # networks that come with the book
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


rule book:
    input:
        notebooks=[run.path(OUT) for run in RUNS],
        sources=[f"notebooks/{chapter}.ipynb" for chapter in chapters.CHAPTERS],
        pages=[str(path) for path in sorted(Path("book").rglob("[!.]*")) if path.is_file()],
        modules=[str(path) for path in sorted(Path("src").rglob("[!.]*.py"))],
        stage=["workflow/stage_book.py", "workflow/toolbox_pages.py", "workflow/check.py"],
        reference=[str(path) for path in sorted(Path("data/reference").glob("[!.]*.json"))],
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
        code=chapters.simulator_digest(),
        made=SESSIONS_ROOT + "/{session}",
    message:
        "simulated session {wildcards.session}"
    shell:  # the writer goes on with what is there, which is right after a stop and wrong after a change of its code
        'made={params.made:q}; [ "$(cat "$made.code" 2>/dev/null)" = {params.code} ] '
        """|| ! grep -qs '"format":' "$made/settings.json" || rm -rf "$made"; """
        'echo {params.code} > "$made.code"; '
        + ENVIRONMENT + "{PYTHON:q} -m {chapters.SIMULATOR} {CONFIG_FILE:q} --session {wildcards.session:q} --out {SESSIONS_ROOT:q} "
        "> {log:q} 2>&1 || {{ tail -n 30 {log:q}; exit 1; }}"


rule sessions:
    input:
        notebook=source("01_sessions"),
        sessions=[session_made(session) for session in SESSIONS],
    output:
        notebook=executed("01_sessions"),
    log:
        **logs("01_sessions"),
    params:
        arguments=arguments("01_sessions"),
        code=DIGESTS["01_sessions"],
    message:
        "01 sessions"
    shell:
        PAPERMILL


rule alignment:
    input:
        notebook=source("02_alignment"),
        session=lambda wildcards: session_made(wildcards.session),
    output:
        notebook=executed("02_alignment"),
        alignment=OUT + "/alignment/{session}/alignment.csv",
    log:
        **logs("02_alignment"),
    params:
        arguments=arguments("02_alignment"),
        code=DIGESTS["02_alignment"],
    message:
        "02 alignment, {wildcards.session}"
    shell:
        PAPERMILL


rule ground_removal:
    input:
        notebook=source("03_ground_removal"),
        session=lambda wildcards: session_made(wildcards.session),
        alignment=OUT + "/alignment/{session}/alignment.csv",
    output:
        notebook=executed("03_ground_removal"),
        pairs=OUT + "/pairs/{session}/pairs.json",
        corrected=OUT + "/pairs-corrected/{session}/pairs.json",
    log:
        **logs("03_ground_removal"),
    params:
        arguments=arguments("03_ground_removal"),
        code=DIGESTS["03_ground_removal"],
    message:
        "03 ground removal, {wildcards.session}"
    shell:
        PAPERMILL


rule pix2pix:
    input:
        notebook=source("04_pix2pix"),
        pairs=f"{OUT}/pairs/{TRAIN}/pairs.json",
    output:
        notebook=executed("04_pix2pix"),
        weights=f"{OUT}/pix2pix/generator.safetensors",
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
        pairs=OUT + "/pairs/{session}/pairs.json",
        weights=TRANSLATION["weights"],
    output:
        OUT + "/fake/{session}/fake.json",
    log:
        OUT + "/logs/generated_images/{session}.log",
    params:
        pairs=OUT + "/pairs/{session}",
        out=OUT + "/fake/{session}",
        options=TRANSLATION["options"],
        code=chapters.script_digest("generate_images.py"),
    priority: 1
    message:
        "generated images, {wildcards.session}"
    shell:  # continues with the images of a stopped run; those of other code are removed
        'made={params.out:q}; [ "$(cat "$made.code" 2>/dev/null)" = {params.code} ] '
        """|| ! grep -qs '"listing": "fake.json"' "$made/settings.json" """
        """|| find "$made" -maxdepth 1 -name '[0-9]*.png' -delete; """
        'echo {params.code} > "$made.code"; '
        + ENVIRONMENT + "OMP_NUM_THREADS={threads} {PYTHON:q} workflow/generate_images.py {params.pairs:q} {input.weights:q} "
        "{params.out:q} --threads {threads} {params.options} > {log:q} 2>&1 || {{ tail -n 30 {log:q}; exit 1; }}"


rule real_vs_fake:
    input:
        notebook=source("05_real_vs_fake"),
        pairs=expand(OUT + "/pairs/{session}/pairs.json", session=SESSIONS),
        corrected=expand(OUT + "/pairs-corrected/{session}/pairs.json", session=LOCALIZE),
        fake=expand(OUT + "/fake/{session}/fake.json", session=SESSIONS),
        weights=f"{OUT}/pix2pix/generator.safetensors",
        shipped=SHIPPED,
    output:
        notebook=executed("05_real_vs_fake"),
        similarity=expand(OUT + "/similarity/{session}.json", session=SESSIONS),
    log:
        **logs("05_real_vs_fake"),
    params:
        arguments=arguments("05_real_vs_fake"),
        code=DIGESTS["05_real_vs_fake"],
    priority: 1
    message:
        "05 real against fake"
    shell:
        PAPERMILL


rule ground_truth:
    input:
        notebook=source("06_ground_truth"),
        sessions=[session_made(session) for session in SESSIONS],
        alignment=expand(OUT + "/alignment/{session}/alignment.csv", session=SESSIONS),
    output:
        notebook=executed("06_ground_truth"),
        summary=f"{OUT}/maps/summary.json",
        maps=expand(OUT + "/maps/{session}.npz", session=SESSIONS),
        truth=expand(OUT + "/ground_truth/{session}.tum", session=SESSIONS),
    log:
        **logs("06_ground_truth"),
    params:
        arguments=arguments("06_ground_truth"),
        code=DIGESTS["06_ground_truth"],
    message:
        "06 ground truth"
    shell:
        PAPERMILL


rule localization:
    input:
        notebook=source("07_localization"),
        fake=OUT + "/fake/{session}/fake.json",
        corrected=OUT + "/pairs-corrected/{session}/pairs.json",
        summary=f"{OUT}/maps/summary.json",
        map=f"{OUT}/maps/{TRAIN}.npz",
        truth=OUT + "/ground_truth/{session}.tum",
    output:
        notebook=executed("07_localization"),
        metrics=OUT + "/localization/{session}/{method}/metrics.json",
    log:
        **logs("07_localization"),
    params:
        arguments=arguments("07_localization"),
        code=DIGESTS["07_localization"],
    message:
        "07 localization, {wildcards.session}, {wildcards.method}"
    shell:
        PAPERMILL


rule results:
    input:
        notebook=source("08_results"),
        metrics=expand(OUT + "/localization/{session}/{method}/metrics.json", session=LOCALIZE, method=METHODS),
        summary=f"{OUT}/maps/summary.json",
        tables=[str(path) for path in sorted(Path("data/paper").glob("[!.]*.csv"))],
    output:
        notebook=executed("08_results"),
    log:
        **logs("08_results"),
    params:
        arguments=arguments("08_results"),
        code=DIGESTS["08_results"],
    message:
        "08 results"
    shell:
        PAPERMILL


rule oxford_route:
    input:
        notebook=source("09_oxford_route"),
        tables=[str(path) for path in sorted(Path("data/paper").glob("[!.]*.csv"))],
        measured=[str(path) for path in sorted(Path("data/ablations").glob("route_*.csv"))],
    output:
        notebook=executed("09_oxford_route"),
    log:
        **logs("09_oxford_route"),
    params:
        arguments=arguments("09_oxford_route"),
        code=DIGESTS["09_oxford_route"],
    priority: -1  # needs no other chapter, so it fills gaps
    message:
        "09 the real route"
    shell:
        PAPERMILL


rule real_radar:
    input:
        notebook=source("10_real_radar"),
        weights=f"{OUT}/pix2pix/generator.safetensors",
        shipped=SHIPPED,
    output:
        notebook=executed("10_real_radar"),
    log:
        **logs("10_real_radar"),
    params:
        arguments=arguments("10_real_radar"),
        code=DIGESTS["10_real_radar"],
    message:
        "10 real radar"
    shell:
        PAPERMILL


rule ablations:
    input:
        notebook=source("11_ablations"),
        tables=[str(path) for path in sorted(Path("data/ablations").glob("[!.]*.csv"))],
        cards=[path.replace(".safetensors", ".json") for path in SHIPPED],
    output:
        notebook=executed("11_ablations"),
    log:
        **logs("11_ablations"),
    params:
        arguments=arguments("11_ablations"),
        code=DIGESTS["11_ablations"],
    priority: -1
    message:
        "11 ablations"
    shell:
        PAPERMILL


rule performance:
    input:
        notebook=source("12_performance"),
        measured=[str(path) for path in sorted(Path("data/performance").glob("[!.]*.json"))],
    output:
        notebook=executed("12_performance"),
    log:
        **logs("12_performance"),
    params:
        arguments=arguments("12_performance"),
        code=DIGESTS["12_performance"],
    priority: -1
    message:
        "12 performance"
    shell:
        PAPERMILL
