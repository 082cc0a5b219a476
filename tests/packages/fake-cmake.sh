# records its calls below the folder PREFIX, and builds nothing
PATH=/usr/bin:/bin
set -e
stage=$1
case $1 in --*) ;; *) stage=configure ;; esac
echo "$stage" >> 'PREFIX/calls'
echo "as $1"
if [ -e "PREFIX/fail$1" ]; then echo "no space left" >&2; exit 1; fi
if [ "$1" = --install ]; then
  library=PREFIX/lib/lib$(basename "$2")__typesupport.so
  mkdir -p 'PREFIX/lib' "$2"
  touch "$library"
  printf %s "$library" > "$2/install_manifest.txt"
fi
