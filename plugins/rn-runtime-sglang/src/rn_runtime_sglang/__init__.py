"""SGLang as a runtime: the same backends, executed by an SGLang server on this or another host."""
