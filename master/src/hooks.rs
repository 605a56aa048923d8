//! Places at which tests of this crate stop a thread or make it panic. Other builds have none.

/// A stage of a job's life that runs on a thread of its own, beside the driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    /// Checking a request and working out its views.
    Plan,
    /// Cutting the volume into bricks.
    CutBricks,
    /// Sending bricks over an embedded link.
    SendBricks,
    /// Composing finished tiles into the picture of a frame that is still being drawn.
    Compose,
    /// Encoding and hashing a frame.
    Finish,
}

/// Functions that tests have called at each [`Stage`].
#[derive(Clone, Default)]
pub(crate) struct Hooks {
    #[cfg(test)]
    on_stage: Option<std::sync::Arc<dyn Fn(Stage) + Send + Sync>>,
}

impl Hooks {
    /// Calls `on_stage` as each stage begins, on the stage's thread.
    #[cfg(test)]
    pub(crate) fn new(on_stage: impl Fn(Stage) + Send + Sync + 'static) -> Self {
        Hooks { on_stage: Some(std::sync::Arc::new(on_stage)) }
    }

    /// Says that `stage` begins.
    pub(crate) fn reach(&self, stage: Stage) {
        #[cfg(test)]
        if let Some(on_stage) = &self.on_stage {
            on_stage(stage);
        }
        let _ = stage;
    }
}
