{{- /*
The watcher's own parameters, which it reads only when it starts. The ConfigMap contains them, and a
checksum of them restarts the pods when they change.
*/ -}}
{{- define "fusion.watcherParams" -}}
{{ toJson .Values.watcher.nodeName }}:
  ros__parameters:
    configmap_name: {{ include "ros-service.parametersName" . | toJson }}
    namespace: {{ toJson .Release.Namespace }}
    period: {{ printf "%.3f" (float64 .Values.watcher.period) }}
    ros_params_file_name: "params.yml"
    target_ros_node: {{ toJson .Values.fusion.nodeName }}
{{- end -}}

{{- define "fusion.watcherName" -}}
{{- printf "%s-watcher" (include "ros-service.fullname" .) -}}
{{- end -}}
