"""SGLang as a runtime: the same backends, executed by a served engine on this or another host."""
