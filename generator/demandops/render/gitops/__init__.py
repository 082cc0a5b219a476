"""What a GitOps controller reads: Flux's objects, or Argo CD's."""
