{{- /*
What every ROS 2 pod of this application needs. The file is the same, byte for byte, in each chart
of the application (a test compares them): a library chart would have to be built into every
package, and a chart that is read straight out of a Git folder must work without that step.

Values are written with toJson throughout. JSON is YAML, and no text in a value can become syntax.
*/ -}}

{{- /*
Labels of the objects themselves. There is no helm.sh/chart label: with it, every new chart version
would rewrite every object, and the version of a release stands in the release anyway.
*/ -}}
{{- define "ros.labels" -}}
{{- $more := dict "app.kubernetes.io/part-of" "object-detection-fusion" "app.kubernetes.io/managed-by" .Release.Service -}}
{{- merge (include "ros.selectorLabels" . | fromJson) $more | toJson -}}
{{- end -}}

{{- /* Labels by which a Deployment finds its pods: they can never change, so nothing in them may. */ -}}
{{- define "ros.selectorLabels" -}}
{{- dict "app.kubernetes.io/name" .Chart.Name "app.kubernetes.io/instance" .Release.Name | toJson -}}
{{- end -}}

{{- /* Labels of the pods: the selector's win over those of the values. */ -}}
{{- define "ros.podLabels" -}}
{{- mergeOverwrite (deepCopy .Values.podLabels) (include "ros.selectorLabels" . | fromJson) | toJson -}}
{{- end -}}

{{- /* Name of an image, from a dict of `image` (as in the values) and `default` (the tag to fall back on). */ -}}
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
How a container starts, from a dict of `setup` (scripts to source) and `run` (the command line).
The script is a constant: scripts, node names and topics reach it as arguments of their own, so
that no character in them is ever read by a shell. Without setup scripts the image's own entry
point stays in place and gets the command line.
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
Environment of a container. HOME points to the pod's own volume, because ROS 2 writes its logs below
it and an arbitrary user has no home folder in the image; the values may set another one.
*/ -}}
{{- define "ros.env" -}}
- name: ROS_DOMAIN_ID
  value: {{ .Values.ros.domainId | int | toString | toJson }}
- name: RMW_IMPLEMENTATION
  value: {{ toJson .Values.ros.rmwImplementation }}
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
Probes of a container, from its `probes` values. A probe that names no handler of its own asks
whether `ros2 launch` has a child process: it reads who is whose parent from /proc and looks for a
parent with `launch` among its arguments, but no `--`, which only the shell that still sources the
setup scripts has. That needs no ROS discovery (which costs a second of processor time and fails on
a busy network), no port, and only bash and grep.
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

{{- /* The part of a pod's specification that says where and as whom it runs. */ -}}
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
