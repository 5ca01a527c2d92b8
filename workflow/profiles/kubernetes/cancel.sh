#!/bin/sh
# Remove Jobs and their pods.
exec kubectl delete job --ignore-not-found --wait=false "$@"
