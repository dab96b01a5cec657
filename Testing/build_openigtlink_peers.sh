#!/bin/sh
# Builds the OpenIGTLink example programs that the tests talk to. Safe to call again: what is built stays.
#
#   Testing/build_openigtlink_peers.sh [FOLDER]     default: build/openigtlink-peers in the checkout
#
# Needs the Debian packages openigtlink-examples, libopenigtlink-dev and g++; installs them when it runs as root.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
folder=${1:-$root/build/openigtlink-peers}
sources=/usr/share/doc/openigtlink-examples/examples
programs="Tracker/TrackerServer Tracker/TrackerClient Receiver/ReceiveClient Receiver/ReceiveServer
TrackingData/TrackingDataServer TrackingData/TrackingDataClient Imager/ImagerServer"

find_include() {
    for place in /usr/include/openigtlink /usr/include/igtl /usr/include/OpenIGTLink /usr/local/include/igtl; do
        if [ -f "$place/igtlOSUtil.h" ]; then
            echo "$place"
            return
        fi
    done
}

if [ ! -d "$sources" ] || [ -z "$(find_include)" ] || ! command -v g++ >/dev/null 2>&1; then
    if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
        echo "missing: install openigtlink-examples, libopenigtlink-dev and g++, then run $0 again" >&2
        exit 1
    fi
    apt-get update -q >&2
    DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
        openigtlink-examples libopenigtlink-dev g++ >&2
fi

include=$(find_include)
mkdir -p "$folder"
for program in $programs; do
    name=${program##*/}
    [ -x "$folder/$name" ] && continue
    # Debian keeps sources above a certain size compressed
    if [ -f "$sources/$program.cxx.gz" ]; then
        gzip -dc "$sources/$program.cxx.gz" >"$folder/$name.cxx"
    else
        cp "$sources/$program.cxx" "$folder/$name.cxx"
    fi
    g++ -O1 -w -I"$include" -I"$include/igtlutil" "$folder/$name.cxx" -o "$folder/$name.part" -lOpenIGTLink -lpthread
    mv "$folder/$name.part" "$folder/$name"
done
echo "$folder"
