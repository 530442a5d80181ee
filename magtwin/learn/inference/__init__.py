"""Trained models at work: on runs, on live readings, in torch and as ONNX."""
