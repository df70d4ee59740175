"""Processors that SGLang finds through SGLANG_EXTERNAL_MM_PROCESSOR_PACKAGE."""
