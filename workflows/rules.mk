# Make rules of a run: a stage's record waits for its slice of the configuration and for the record of the stage before.
# `epitransfer configure` rewrites a slice only when it changed, so a changed key (or photo, or tile) reruns the stages
# that read it and what follows. A stage whose inputs came out the same after all is skipped by its key. Exit code 8 (done,
# but too many items failed) stops no stage; `run` looks at all of them at the end.
SECTIONS := $(shell sed -n 's/^ *\[\([a-z]*\)\].*/\1/p' $(WORKFLOW))
ORDER := $(foreach stage,ingest pair match refine depth fuse score sensitivity report,$(filter $(stage),$(SECTIONS)))
RECORDS := $(ORDER:%=$(OUT)/.stages/%.json)
SLICES := $(ORDER:%=$(OUT)/.slices/%.json)

.PHONY: configure
configure: | $(READY)
	@$(BIN)/epitransfer configure $(OUT) --workflow $(WORKFLOW)

$(SLICES): configure ;

define STAGE_RULE
$(OUT)/.stages/$(1).json: $(OUT)/.slices/$(1).json $(2)
	@$(BIN)/epitransfer $(1) $(OUT) --jobs $(JOBS) >/dev/null || [ $$$$? -eq 8 ]
endef
PREVIOUS :=
$(foreach stage,$(ORDER),$(eval $(call STAGE_RULE,$(stage),$(PREVIOUS)))$(eval PREVIOUS := $(OUT)/.stages/$(stage).json))
