{{- /*
Names and labels. Every value is written with toJson: JSON is valid YAML, and text in a value cannot
become syntax.
*/ -}}

{{- /* Name of the objects. */ -}}
{{- define "ros-service.fullname" -}}
{{- .Values.fullnameOverride | default .Release.Name -}}
{{- end -}}

{{- /*
Labels of the objects, without chart or version: they would change every object with each new chart.
The release contains the chart's version, the Deployment that of the image.
*/ -}}
{{- define "ros-service.labels" -}}
{{- $more := dict "app.kubernetes.io/component" "service" "app.kubernetes.io/managed-by" .Release.Service -}}
{{- mergeOverwrite $more .Values.commonLabels (include "ros-service.selectorLabels" . | fromJson) | toJson -}}
{{- end -}}

{{- /* Labels by which a Deployment selects its pods. Kubernetes does not allow them to change. */ -}}
{{- define "ros-service.selectorLabels" -}}
{{- dict "app.kubernetes.io/name" .Chart.Name "app.kubernetes.io/instance" .Release.Name | toJson -}}
{{- end -}}

{{- /* Labels of the pods: labels of the selector replace those of the values. */ -}}
{{- define "ros-service.podLabels" -}}
{{- mergeOverwrite (deepCopy .Values.podLabels) (include "ros-service.selectorLabels" . | fromJson) | toJson -}}
{{- end -}}

{{- define "ros-service.serviceAccountName" -}}
{{- if .Values.serviceAccount.create -}}
{{- .Values.serviceAccount.name | default (include "ros-service.fullname" .) -}}
{{- else -}}
{{- .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}
