#!/usr/bin/env bash
# Try the README's two commands on a minimal Debian with nothing but the packages that README.md names:
#
#   workflow/try_fresh.sh SUITE [COMMAND...]     bookworm or trixie; other commands than these two, each one word
#
# Needs Debian, root, and some GB in TMPDIR. It clones the last commit, works as an ordinary user, and removes the system
# afterwards. CLONE may name the clone's folder, which tries a name with spaces.
# Sources, proxies and certificates of apt and pip are the host's, local folders that pip's settings name are readable.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { echo "try_fresh: $*"; }
fail() {
    say "$*" >&2
    exit 1
}

[ $# -gt 0 ] || fail "name a suite of Debian: bookworm or trixie"
[ "$(id -u)" = 0 ] || fail "must be run as root"
command -v apt-get >/dev/null || fail "must be run on Debian or Ubuntu"
suite=$1
shift
[ $# -gt 0 ] || set -- "make book PROFILE=smoke" "make test"
clone=${CLONE:-radar-on-lidar}
system=$(mktemp -d "${TMPDIR:-/tmp}/try_fresh-$suite.XXXXXX")
trap 'rm -rf --one-file-system "$system" "$system.log"' EXIT
chmod 755 "$system"

# Run a command in the new system, as root unless options of chroot say otherwise. Mounts end with the command.
inside() {
    unshare --mount --pid --fork bash -euc '
        mount -t proc proc "$1/proc"
        mount --rbind /dev "$1/dev"
        while read -r path; do
            if [ -z "$path" ]; then continue; fi
            if [ -d "$path" ]; then mkdir -p "$1$path"; else mkdir -p "$(dirname "$1$path")"; touch "$1$path"; fi
            mount --bind "$path" "$1$path"
        done <<<"$2"
        exec chroot "${@:3}"' inside "$system" "$shared" "$@"
}

# pip's settings from files, as one file.
pip_settings() {
    python3 -m pip config list 2>/dev/null | python3 -c '
import ast, configparser, sys
settings = configparser.RawConfigParser()
for line in sys.stdin:
    name, _, value = line.partition("=")
    section, _, key = name.partition(".")
    if not section.startswith(":"):
        settings.read_dict({section: {key: ast.literal_eval(value)}})
settings.write(sys.stdout)'
}

# Files and folders of the host that these settings name; beside the folder of an index lie its files.
named_paths() {
    { env | grep -E "$passed"; cat "$system/etc/pip.conf"; } | grep -oE '(file://)?/[^ ]+' | sort -u |
        while read -r path; do
            case $path in file://*) path=$(dirname "${path#file://}") ;; esac
            if [ -e "$path" ]; then echo "$path"; fi
        done
}

command -v debootstrap >/dev/null || DEBIAN_FRONTEND=noninteractive apt-get install -qq -y debootstrap >/dev/null
mirror=$(apt-get indextargets --format '$(LABEL) $(REPO_URI)' | sed -n 's/^Debian //p' | head -n 1)
say "$suite from the host's mirror"
debootstrap --variant=minbase "$suite" "$system" "${mirror:-}" >"$system.log" || { tail "$system.log"; fail "debootstrap failed"; }
cp /etc/resolv.conf /etc/hosts "$system/etc/"
apt-config dump | grep -E '^Acquire::(http|https|Check)' >"$system/etc/apt/apt.conf.d/99host" || true
shared=
read -r -d '' -a packages <apt.txt || true
inside "$system" apt-get update -qq
inside "$system" env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends "${packages[@]}" >/dev/null

passed='^(PIP_.*|UV_.*|.*_CA_BUNDLE|SSL_CERT_.*|[a-z]*_proxy|[A-Z]*_PROXY)='
pip_settings >"$system/etc/pip.conf"
shared=$(named_paths)
readarray -t variables < <(env | grep -E "$passed")
git clone -q . "$system/srv/$clone"
inside "$system" useradd --create-home --home-dir /srv/reader reader
chown -R --reference="$system/srv/reader" "$system/srv/$clone"
as_user() {
    inside --userspec=reader:reader "$system" env -i PATH=/usr/bin:/bin LANG=C.UTF-8 HOME=/srv/reader "${variables[@]}" \
        bash -euc "cd \"/srv/$clone\"; $1"
}
say "$(. "$system/etc/os-release" && echo "$PRETTY_NAME"), $(as_user 'python3 --version'), commit $(git rev-parse --short HEAD)"
for command in "$@"; do
    started=$SECONDS
    as_user "$command"
    say "$command: $((SECONDS - started)) s, $(du -sh "$system/srv/$clone" | cut -f 1)"
done
say "passed on $suite: $*"
