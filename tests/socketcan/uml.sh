#!/bin/bash
# Runs a command in a User-Mode Linux guest whose kernel has CAN (can, can-raw, can-bcm, vcan), for machines without it.
# The guest mounts the file tree of this machine read-only and so has the same Python environment. Needs no root and no KVM.
#
#   uml.sh -c CACHE -o OUT [-m MEMORY] [-t SECONDS] command args...
#
# CACHE keeps the Debian package user-mode-linux (41 MB), downloaded at the first use. OUT is the only folder to which the
# guest can write. Exit status: that of the command; 69: the package is not available; 70: the guest could not start (see
# boot.log); 71: the guest started but wrote no exit status.
set -u
memory=1024M limit=600 cache='' out=''
while getopts m:c:o:t: flag; do
    case $flag in m) memory=$OPTARG ;; c) cache=$OPTARG ;; o) out=$OPTARG ;; t) limit=$OPTARG ;; *) exit 64 ;; esac
done
shift $((OPTIND - 1))
[ -n "$cache" ] && [ -n "$out" ] && [ $# -ge 1 ] || { echo "usage: uml.sh -c CACHE -o OUT command args..." >&2; exit 64; }
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

fetch() {  # unpacked into another folder and moved, so that an incomplete download is never used
    mkdir -p "$cache" && rm -rf "$cache/new" && mkdir "$cache/new" || return
    ls "$cache"/user-mode-linux_*.deb >/dev/null 2>&1 || ( cd "$cache" && timeout 300 apt-get download user-mode-linux >&2 ) || return
    dpkg-deb -x "$cache"/user-mode-linux_*.deb "$cache/new" && mv "$cache/new" "$cache/unpacked"
}

if [ -x /usr/bin/linux.uml ]; then tree=/; else
    tree=$cache/unpacked
    [ -x "$tree/usr/bin/linux.uml" ] || fetch || { echo "the Debian package user-mode-linux cannot be downloaded" >&2; exit 69; }
fi
modules=$(echo "$(realpath "$tree")"/usr/lib/uml/modules/*/kernel)
mkdir -p "$out"; out=$(realpath "$out"); rm -f "$out/rc" "$out/started"
python=$(command -v python3)

quoted() { printf '%q ' "$@"; echo; }
{
    echo '#!/bin/bash'
    for name in PATH PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH ST_ENVIRONMENT ST_WORKSPACE ROS_DISTRO _ROS_WHEELS_BOOTSTRAP_COMPLETE \
        ROS_AUTOMATIC_DISCOVERY_RANGE FASTRTPS_DEFAULT_PROFILES_FILE
    do [ -z "${!name:-}" ] || printf 'export %s=%q\n' "$name" "${!name}"; done
    echo 'export HOME=/run TMPDIR=/run LANG=C.UTF-8 PYTHONDONTWRITEBYTECODE=1 ROS_LOG_DIR=/run/ros'
    echo 'mount -t proc p /proc; mount -t sysfs s /sys; mount -t tmpfs t /run; mkdir -p /dev/shm; mount -t tmpfs t /dev/shm'
    quoted mount -t hostfs none "$out" -o "$out,rw"
    quoted touch "$out/started"
    quoted "$python" "$here/load_modules.py" "$modules"/{net/can/can,net/can/can-raw,net/can/can-bcm,drivers/net/can/dev/can-dev,drivers/net/can/vcan}.ko
    echo 'ip link set lo up; ip link set lo multicast on'
    quoted cd "$PWD"
    quoted "$@"
    printf 'echo $? > %q; sync; echo o > /proc/sysrq-trigger; sleep 5\n' "$out/rc"
} >"$out/init"
chmod +x "$out/init"

timeout -k 5 "$limit" "$tree/usr/bin/linux.uml" mem="$memory" root=/dev/root rootfstype=hostfs rootflags=/ ro quiet loglevel=1 \
    init="$out/init" con=null con0=null,fd:1 con1=null ssl=null </dev/null 2>"$out/boot.log" | tr -d '\r' | tee "$out/console.log"
[ -s "$out/rc" ] && exit "$(cat "$out/rc")"
[ -e "$out/started" ] && { echo "the guest wrote no exit status" >&2; exit 71; }
echo "User-Mode Linux could not start: $(tail -n 3 "$out/boot.log" "$out/console.log" | tr '\n' ' ')" >&2
exit 70
