#!/bin/sh
# Hand one job script of Snakemake to Kubernetes as a Job, and print the Job's name. Called by Snakemake with the settings
# of config.yaml in the environment and the path of the script. The pod mounts the volume where it is mounted here, works
# in this very folder, and so sees the same files.
#
# The Job has one pod and one try; it ends when its minutes are over and is removed a day later.
# IMAGE: container image; CLAIM: persistent volume claim; MOUNT: where the volume is mounted, here and in the pod; RULE,
# CORES, MEMORY [MB], MINUTES: of the job; GPUS: graphics cards of NVIDIA, 0 for none.
set -eu
case "$PWD/" in
"$MOUNT"/*) ;;
*) echo "$PWD does not lie on the volume, which is mounted at $MOUNT" >&2 && exit 1 ;;
esac
name=$(echo "$RULE" | tr _ -)
quoted() { printf "'%s'" "$(printf %s "$1" | sed "s/'/''/g")"; }
kubectl create --filename - --output 'jsonpath={.metadata.name}' <<JOB
apiVersion: batch/v1
kind: Job
metadata:
  generateName: rol-$name-
  labels: {app: radar-on-lidar, rule: $name}
spec:
  backoffLimit: 0
  activeDeadlineSeconds: $((60 * MINUTES))
  ttlSecondsAfterFinished: 86400
  template:
    spec:
      restartPolicy: Never
      containers:
        - name: job
          image: $IMAGE
          command: [sh, $(quoted "$1")]
          workingDir: $(quoted "$PWD")
          resources:
            requests: {cpu: "$CORES", memory: ${MEMORY}M}
            limits: {memory: ${MEMORY}M$([ "$GPUS" = 0 ] || echo ", nvidia.com/gpu: \"$GPUS\"")}
          volumeMounts: [{name: volume, mountPath: $(quoted "$MOUNT")}]
      volumes: [{name: volume, persistentVolumeClaim: {claimName: $CLAIM}}]
JOB
