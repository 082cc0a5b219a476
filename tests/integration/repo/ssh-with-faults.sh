for last; do :; done
case $last in
  git-receive-pack*)
    [ ! -e "$0.push" ] || sleep 1000
    [ -z "$SAYS" ] || [ -e "$0.open" ] || { printf '%b\n' "$SAYS" >&2; exit 1; } ;;
  *) [ ! -e "$0.fetch" ] || sleep 1000 ;;
esac
exec sh -c "$last"
