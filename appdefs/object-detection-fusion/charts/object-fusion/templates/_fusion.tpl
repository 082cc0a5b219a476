{{- /*
The watcher's own parameters, which it reads only when it starts. The ConfigMap contains them, and a
checksum of them restarts the pods when they change.
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
{{- printf "%s-params" (include "ros-service.fullname" .) -}}
{{- end -}}

{{- define "fusion.watcherName" -}}
{{- printf "%s-watcher" (include "ros-service.fullname" .) -}}
{{- end -}}

{{- /*
A list of topics in a form that ROS 2 accepts. An empty YAML list has no element type: a node that
starts with it gets no value, and rclpy sends it as a list of booleans, which a node refuses. So an
empty list becomes a list with one empty string, which cannot be a topic's name.
*/ -}}
{{- define "fusion.topics" -}}
{{- . | uniq | sortAlpha | default (list "") | toJson -}}
{{- end -}}

{{- /* The volume with the account's token, as Kubernetes' client libraries expect it. */ -}}
{{- define "fusion.apiAccess" -}}
name: api-access
projected:
  sources:
    - serviceAccountToken:
        path: token
        expirationSeconds: 3607
    - configMap:
        name: kube-root-ca.crt
        items:
          - key: ca.crt
            path: ca.crt
    - downwardAPI:
        items:
          - path: namespace
            fieldRef:
              apiVersion: v1
              fieldPath: metadata.namespace
{{- end -}}
