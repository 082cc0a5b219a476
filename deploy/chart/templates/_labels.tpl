{{- define "labels" -}}
{{ include "selectorLabels" . }}
app.kubernetes.io/managed-by: {{ toJson .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version | toJson }}
{{- end -}}

{{- define "selectorLabels" -}}
app.kubernetes.io/name: {{ toJson .Chart.Name }}
app.kubernetes.io/instance: {{ toJson .Release.Name }}
{{- end -}}
