#!/bin/sh
# Runs one of git's programs, under strace if it is the process that is asked for.
program=${0##*/}
command=${program#git-}
if [ "$program" = git ]; then
  for command in "$@"; do case $command in -* | *=*) ;; *) break ;; esac; done
fi
if [ -n "$FAULTS_AT" ]; then
  number=1
  set -C  # so that > fails if the file exists; mkdir would do, but it would be a process
  until true 2>/dev/null >"$FAULTS_TRACES/$command $number"; do number=$((number + 1)); done
  case "$FAULTS_AT" in git | "git $command $number")
    trace="$FAULTS_TRACES/$command $number"
    pwd -P >"$trace.folder"
    exec strace -y -o "$trace.calls" $FAULTS_STRACE "$FAULTS_EXEC/$program" "$@"
    ;;
  esac
fi
exec "$FAULTS_EXEC/$program" "$@"
