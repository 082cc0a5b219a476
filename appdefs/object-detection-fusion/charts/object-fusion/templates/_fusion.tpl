{{- /*
The watcher's own parameters, which it reads once when it starts. Both the ConfigMap that holds them
and the checksum that restarts the pods on a change come from here.
*/ -}}
{{- define "fusion.watcherParams" -}}
{{ toJson .Values.watcher.nodeName }}:
  ros__parameters:
    configmap_name: {{ include "fusion.paramsName" . | toJson }}
    namespace: {{ toJson .Release.Namespace }}
    period: {{ printf "%.3f" (float64 .Values.watcher.period) }}
    ros_params_file_name: "params.yml"
    target_ros_node: {{ toJson .Values.fusion.nodeName }}
{{- end -}}

{{- define "fusion.paramsName" -}}
{{- printf "%s-params" .Release.Name -}}
{{- end -}}

{{- define "fusion.watcherName" -}}
{{- printf "%s-watcher" .Release.Name -}}
{{- end -}}

{{- /*
A list of topics as ROS 2 can take it. An empty YAML list has no element type: a node that starts
with it finds no value, and rclpy sends it as a list of booleans, which a node refuses for a list of
texts. One empty text is the usual stand-in; no topic can have that name.
*/ -}}
{{- define "fusion.topics" -}}
{{- . | uniq | sortAlpha | default (list "") | toJson -}}
{{- end -}}
