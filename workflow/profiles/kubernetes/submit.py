"""Hand one job script of Snakemake to Kubernetes as a Job, and print the Job's name.

Called by Snakemake with the options of config.yaml and the path of the script last. The pod mounts the volume where it is
mounted here, works in this very folder, and so sees the same files.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path


def manifest(given: argparse.Namespace, folder: Path) -> dict:
    """Describe the Job.

    Parameters
    ----------
    given : argparse.Namespace
        The command line, see `read_arguments`.
    folder : Path
        Where the job works; must lie on the volume.

    Returns
    -------
    job : dict
        A Job of ``batch/v1``: one pod, one try, ended when its minutes are over, removed a day later.

    Raises
    ------
    ValueError
        If the folder does not lie on the volume.
    """
    if not folder.is_relative_to(given.mount):
        raise ValueError(f"{folder} does not lie on the volume, which is mounted at {given.mount}")
    resources = {"cpu": str(given.cores), "memory": f"{given.memory}M"}
    gpus = {"nvidia.com/gpu": str(given.gpus)} if given.gpus else {}
    container = {
        "name": "job",
        "image": given.image,
        "command": ["sh", str(given.script)],
        "workingDir": str(folder),
        "resources": {"requests": resources, "limits": {"memory": resources["memory"], **gpus}},
        "volumeMounts": [{"name": "volume", "mountPath": str(given.mount)}],
    }
    volume = {"name": "volume", "persistentVolumeClaim": {"claimName": given.claim}}
    pod = {"restartPolicy": "Never", "containers": [container], "volumes": [volume]}
    name = given.rule.replace("_", "-")
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"generateName": f"rol-{name}-", "labels": {"app": "radar-on-lidar", "rule": name}},
        "spec": {
            "backoffLimit": 0,
            "activeDeadlineSeconds": 60 * given.minutes,
            "ttlSecondsAfterFinished": 24 * 3600,
            "template": {"spec": pod},
        },
    }


def read_arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", required=True, help="container image")
    parser.add_argument("--claim", required=True, help="name of the persistent volume claim")
    parser.add_argument(
        "--mount", required=True, type=Path, help="where the volume is mounted, here and in the pod"
    )
    parser.add_argument("--rule", required=True, help="rule of the Snakefile, for the Job's name")
    parser.add_argument("--cores", required=True, type=int)
    parser.add_argument("--memory", required=True, type=int, help="in MB")
    parser.add_argument("--minutes", required=True, type=int, help="longest time that the job may take")
    parser.add_argument("--gpus", type=int, default=0, help="graphics cards of NVIDIA; none if not given")
    parser.add_argument("script", type=Path, help="what the job runs")
    return parser.parse_args(words)


def main() -> None:
    """Create the Job and print its name."""
    job = json.dumps(manifest(read_arguments(), Path.cwd()))
    command = ["kubectl", "create", "--filename", "-", "--output", "jsonpath={.metadata.name}"]
    print(subprocess.run(command, input=job, encoding="utf-8", check=True, stdout=subprocess.PIPE).stdout)


if __name__ == "__main__":
    main()
