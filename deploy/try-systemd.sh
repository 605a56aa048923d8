#!/usr/bin/env bash
# Checks the units: `systemd-analyze verify`, and how exposed they are. No service is started.
# ExecStart= names /usr/local/bin/slabcast; until that is installed, copies of the units that
# name a stand-in are checked.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
units=$(mktemp -d)
trap 'rm -rf "$units"' EXIT
cp "$here"/slabcast-master.service "$here"/slabcast-worker@.service "$units"
if [ ! -x /usr/local/bin/slabcast ]; then
    echo "no /usr/local/bin/slabcast; checking with a stand-in"
    sed -i 's#^ExecStart=/usr/local/bin/slabcast#ExecStart=/bin/true#' "$units"/*.service
fi
# A template is checked as an instance of it.
mv "$units/slabcast-worker@.service" "$units/slabcast-worker@0.service"
systemd-analyze verify --man=no "$units"/*.service
echo "systemd-analyze verify: no complaint"
for unit in slabcast-master slabcast-worker@0; do
    systemd-analyze security --offline=true --no-pager "$units/$unit.service" | tail -1
done
