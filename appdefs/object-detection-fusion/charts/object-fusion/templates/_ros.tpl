{{- /*
Helpers for every ROS 2 pod of this application. Each chart of the application has an identical copy
of this file (a test compares them). A library chart would need a build step, and a chart in a Git
folder must work without one.

All values are written with toJson: JSON is valid YAML, and text in a value cannot become syntax.
*/ -}}

{{- /*
Labels of the objects. There is no helm.sh/chart label, because then each new chart version would
change every object. The release already contains the chart's version.
*/ -}}
{{- define "ros.labels" -}}
{{- $more := dict "app.kubernetes.io/part-of" "object-detection-fusion" "app.kubernetes.io/managed-by" .Release.Service -}}
{{- merge (include "ros.selectorLabels" . | fromJson) $more | toJson -}}
{{- end -}}

{{- /* Labels by which a Deployment selects its pods. Kubernetes does not allow them to change. */ -}}
{{- define "ros.selectorLabels" -}}
{{- dict "app.kubernetes.io/name" .Chart.Name "app.kubernetes.io/instance" .Release.Name | toJson -}}
{{- end -}}

{{- /* Labels of the pods: labels of the selector replace those of the values. */ -}}
{{- define "ros.podLabels" -}}
{{- mergeOverwrite (deepCopy .Values.podLabels) (include "ros.selectorLabels" . | fromJson) | toJson -}}
{{- end -}}

{{- /* Name of an image, from a dict of `image` (as in the values) and `default` (the default tag). */ -}}
{{- define "ros.image" -}}
{{- if .image.digest -}}
{{- printf "%s@%s" .image.repository .image.digest | toJson -}}
{{- else -}}
{{- printf "%s:%s" .image.repository (.image.tag | default .default) | toJson -}}
{{- end -}}
{{- end -}}

{{- define "ros.serviceAccountName" -}}
{{- if .Values.serviceAccount.create -}}
{{- .Values.serviceAccount.name | default .Release.Name -}}
{{- else -}}
{{- .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}

{{- /*
The command of a container, from a dict of `setup` (scripts to source) and `run` (the command line).
The shell script is a constant. Setup scripts, node names and topics are separate arguments, so the
shell never interprets their characters. Without setup scripts, the image's own entry point gets the
command line.
*/ -}}
{{- define "ros.start" -}}
{{- if .setup -}}
command: ["/bin/bash", "-c", "while [ \"$1\" != -- ]; do . \"$1\" || exit; shift; done; shift; exec \"$@\"", "start"]
args: {{ concat .setup (list "--") .run | toJson }}
{{- else -}}
args: {{ toJson .run }}
{{- end -}}
{{- end -}}

{{- /*
Environment of a container. HOME is a volume of the pod, because ROS 2 writes its logs there and an
arbitrary user has no home folder in the image. The values may set another HOME.
*/ -}}
{{- define "ros.env" -}}
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
Probes of a container, from its `probes` values. A probe without a handler checks whether
`ros2 launch` has a child process. It reads the parent processes from /proc and looks for one with
`launch` but without `--` in its arguments: only the shell that sources the setup scripts has `--`.
The check needs bash and grep, but no port and no ROS discovery, which takes a second of processor
time and fails on a busy network.
*/ -}}
{{- define "ros.probes" -}}
{{- $check := "grep -hs ^PPid: /proc/[0-9]*/status | { while read -r _ parent; do if grep -qszx launch /proc/$parent/cmdline; then grep -qszxe -- /proc/$parent/cmdline || exit 0; fi; done; exit 1; }" -}}
{{- $probes := . -}}
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

{{- /* The part of a pod's specification about its node, its account and its rights. */ -}}
{{- define "ros.podSpec" -}}
{{- with include "ros.serviceAccountName" . -}}
serviceAccountName: {{ toJson . }}
{{ end -}}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with .Values.imagePullSecrets }}
imagePullSecrets: {{ toJson . }}
{{- end }}
{{- if .Values.hostNetwork }}
hostNetwork: true
dnsPolicy: ClusterFirstWithHostNet
{{- end }}
{{- with .Values.podSecurityContext }}
securityContext: {{ toJson . }}
{{- end }}
terminationGracePeriodSeconds: {{ .Values.terminationGracePeriodSeconds | int }}
{{- with .Values.nodeSelector }}
nodeSelector: {{ toJson . }}
{{- end }}
{{- with .Values.tolerations }}
tolerations: {{ toJson . }}
{{- end }}
{{- with .Values.affinity }}
affinity: {{ toJson . }}
{{- end }}
{{- end -}}
