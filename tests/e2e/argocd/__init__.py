"""The same chain with Argo CD in Flux's place."""
