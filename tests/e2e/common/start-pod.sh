# Make a pod's root file system and become its command. Arguments: the root's folder; the image; the
# folders and the Python that replace an image; MODE:SOURCE:TARGET for each volume; user; group; and
# the command.
root=$1 image=$2 folders=$3 python=$4 volumes=$5 user=$6 group=$7
shift 7
show_folders() {
  for folder in $folders; do
    [ -z "$(ls -A "$root$folder" 2>/dev/null)" ] || continue
    mkdir -p "$root$folder"
    mount --bind "$folder" "$root$folder"
    mount -o remount,bind,ro "$root$folder"
  done
}
mount -t tmpfs -o mode=755 tmpfs "$root"
if [ -n "$image" ]; then
  mkdir "$root/above" "$root/work" "$root/merged"
  mount -t overlay -o "lowerdir=$image,upperdir=$root/above,workdir=$root/work" pod "$root/merged"
  root=$root/merged
else
  cp -a /etc /bin /sbin /lib* "$root/"
  echo "demandops:x:$user:$group::/:/bin/sh" >>"$root/etc/passwd"
  mkdir "$root/image"
  printf '#!/bin/sh\nexec %s -m demandops.cli.main "$@"\n' "$python" >"$root/image/demandops"
  chmod 755 "$root/image/demandops"
  show_folders
fi
mkdir -p "$root/proc" "$root/dev"
mount --bind /proc "$root/proc"
mount --bind /dev "$root/dev"
mount -t tmpfs -o mode=700 tmpfs "$root/dev/shm"
for volume in $volumes; do
  mode=${volume%%:*} target=${volume##*:} source=${volume#*:}
  chroot "$root" mkdir -p "$target"
  target=$(chroot "$root" realpath "$target")  # an image's link must not lead out of it
  mount --bind "${source%:*}" "$root$target"
  mount -o "remount,bind,$mode" "$root$target"
done
[ -n "$image" ] || show_folders  # a volume may hide one: this checkout may be below /tmp
mount -o remount,bind,ro "$root"
cd /
exec chroot "$root" setpriv --reuid "$user" --regid "$group" --groups "$group" \
  --bounding-set=-all --inh-caps=-all --no-new-privs --pdeathsig KILL env -i "$@"
