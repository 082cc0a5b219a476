{{- /*
A container that runs one command of ROS 2, from a dict:

  root       the chart's own context, `$`
  name       of the container
  values     the map with its image, probes and resources, usually .Values
  run        the command, a list
  tmp        the volume for its /tmp, by default "tmp"
  mounts     further volume mounts, a list; optional
  setup      scripts to source first, a list; by default .Values.workspaceSetup
*/ -}}
{{- define "ros-service.container" -}}
- name: {{ toJson .name }}
  image: {{ include "ros-service.image" . }}
  imagePullPolicy: {{ toJson .values.image.pullPolicy }}
  {{- include "ros-service.start" . | nindent 2 }}
  env:
    {{- include "ros-service.env" .root | nindent 4 }}
  {{- with include "ros-service.probes" . | trim }}{{ nindent 2 . }}{{ end }}
  resources: {{ toJson .values.resources }}
  securityContext: {{ toJson .root.Values.securityContext }}
  volumeMounts: {{ prepend (.mounts | default list) (dict "name" (.tmp | default "tmp") "mountPath" "/tmp") | toJson }}
{{- end -}}

{{- define "ros-service.image" -}}
{{- with .values.image -}}
{{- $_ := required "image.repository is empty: name the image, with its registry" .repository -}}
{{- if .digest -}}
{{- printf "%s@%s" .repository .digest | toJson -}}
{{- else -}}
{{- printf "%s:%s" .repository (.tag | default $.root.Chart.AppVersion | default "latest") | toJson -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{- /*
The shell script is a constant. Setup scripts, node names and topics are separate arguments, so the
shell never interprets their characters. Without setup scripts, the image's own entry point gets the
command line.
*/ -}}
{{- define "ros-service.start" -}}
{{- with hasKey . "setup" | ternary .setup .root.Values.workspaceSetup -}}
command: ["/bin/bash", "-c", "while [ \"$1\" != -- ]; do . \"$1\" || exit; shift; done; shift; exec \"$@\"", "start"]
args: {{ concat . (list "--") $.run | toJson }}
{{- else -}}
args: {{ toJson .run }}
{{- end -}}
{{- end -}}

{{- /*
HOME is a volume of the pod, because ROS 2 writes its logs there and an arbitrary user has no home
folder in the image. The values may set another HOME.
*/ -}}
{{- define "ros-service.env" -}}
- name: ROS_DOMAIN_ID
  value: {{ .Values.ros.domainId | int | toString | toJson }}
{{- with .Values.ros.rmwImplementation }}
- name: RMW_IMPLEMENTATION
  value: {{ toJson . }}
{{- end }}
{{- $named := dict }}
{{- range .Values.ros.env }}{{ $_ := set $named .name true }}{{ end }}
{{- if not (hasKey $named "HOME") }}
- name: HOME
  value: "/tmp"
{{- end }}
{{- range .Values.ros.env }}
- {{ toJson . }}
{{- end }}
{{- end -}}

{{- /*
A probe without a handler checks whether `ros2 launch` (or `ros2 run`, if that is the command) has a
child process. It reads the parent processes from /proc and looks for one with `launch` but without
`--` in its arguments: only the shell that sources the setup scripts has `--`. The check needs bash and grep, but no port and no ROS
discovery, which takes a second of processor time and fails on a busy network.
*/ -}}
{{- define "ros-service.probes" -}}
{{- $check := "grep -hs ^PPid: /proc/[0-9]*/status | { while read -r _ parent; do if grep -qszx launch /proc/$parent/cmdline; then grep -qszxe -- /proc/$parent/cmdline || exit 0; fi; done; exit 1; }" -}}
{{- if eq (index .run 1) "run" -}}{{- $check = replace "-qszx launch" "-qszx run" $check -}}{{- end -}}
{{- $probes := .values.probes -}}
{{- range $kind := list "startup" "readiness" "liveness" }}
{{- $probe := get $probes $kind }}
{{- if kindIs "map" $probe }}
{{- if not (or $probe.exec $probe.httpGet $probe.tcpSocket $probe.grpc) }}
{{- $probe = merge (dict "exec" (dict "command" (list "/bin/bash" "-c" $check))) $probe }}
{{- end }}
{{ $kind }}Probe: {{ toJson $probe }}
{{- end }}
{{- end }}
{{- end -}}
