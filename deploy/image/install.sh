#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Installs Cellwatch on this computer: a Jetson that is already set up, or the master's.
#   sudo deploy/image/install.sh --wheelhouse wheels --token unit.token [--master URL] [--ca ca.pem]
#   sudo deploy/image/install.sh --role master --wheelhouse wheels --cell my-cell/
# Options are those of customize-rootfs. A second run with a newer wheelhouse updates; the previous release stays beside it.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

"$here/customize-rootfs" / "$@"

systemctl daemon-reload
systemctl restart systemd-journald.service
# A container has no udev and no cameras.
if [ -f /etc/udev/rules.d/70-cellwatch-realsense.rules ] && [ -S /run/udev/control ]; then
    udevadm control --reload
    # Apply the rules to cameras that are already plugged in.
    udevadm trigger --subsystem-match=usb --subsystem-match=hidraw
fi
# A master on the same computer as a unit runs the same release.
for service in master-server.service edge-unit.service; do
    [ -f "/etc/systemd/system/$service" ] || continue
    systemctl restart "$service"
    systemctl --no-pager --lines=5 status "$service"
done
