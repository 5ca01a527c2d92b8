#!/bin/sh
# Say how a Job stands, in Snakemake's words: success, failed or running. A Job that is no longer known has failed.
set -eu
fields='jsonpath={.metadata.name} {.status.conditions[*].type}'
if ! answer=$(kubectl get job "$1" --ignore-not-found --output "$fields"); then
    answer="$1 not told" # the cluster does not answer now; Snakemake asks again
fi
case "$answer" in
*Complete*) echo success ;;
*Failed* | "") echo failed ;;
*) echo running ;;
esac
