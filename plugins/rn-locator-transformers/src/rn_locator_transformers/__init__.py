"""Zero-shot detectors of the library transformers as a locator."""
