"""Manifests: tables of tactile frames."""
