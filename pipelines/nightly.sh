#!/bin/bash
# One night: ingest the new logs, build the dataset, check everything. Prints nothing if nobody has to do anything.
#   nightly.sh DIRECTORY      DIRECTORY has recordings/ and, if you need one, tcpipe.toml; it gets dataset/ and night/
# docs/how-to/run-unattended.md
set -o pipefail
cd "$1" && mkdir -p night && exec 9> night/lock || exit 1
if ! flock --nonblock 9; then
    echo "An earlier night still runs. It has printed:"
    tail -n +1 night/*.txt
    tcpipe status
    exit 1
fi
rm -f night/*.txt

exit_code=0
run() {
    local printed ended
    printed=$(tcpipe "$@" 2>&1 | tee "night/$1.txt") && return # in memory: a full disk keeps no text
    ended=$?
    [ $exit_code = 1 ] || echo "$printed" | grep --max-count 1 '^tcpipe: ' # the first line of the mail is the reason
    echo "tcpipe $*: exit code $ended"
    echo "$printed"
    exit_code=1
}
run ingest recordings --existing-store --jobs 4 --min-age 10m --quiet
run build-dataset dataset --jobs 4 --quiet
run status
exit $exit_code
