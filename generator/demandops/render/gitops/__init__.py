"""The manifests that a GitOps controller reads: Flux's or Argo CD's."""
