//! Scenes of formula volumes, one for each source of error by sheet thickness.

/// A formula volume and its transfer function.
pub(crate) struct Scene {
    /// Name in tables and file names.
    pub(crate) name: &'static str,
    /// The volume.
    pub(crate) volume: &'static str,
    /// The transfer function, as JSON.
    pub(crate) transfer: &'static str,
}

/// One scene for each thing that can go wrong with thickness, 24 to 32 voxels wide so that all
/// of them take a minute together.
pub(crate) const SCENES: [Scene; 5] = [
    // One colour: whatever shows here is no matter of colour.
    Scene {
        name: "wall",
        volume: "formula:wall:24",
        transfer: r#"{"version":1,"domain":"value","color_space":"linear",
            "colors":[[200,0.25,0.5,1]],"opacities":[[199,0],[200,0.2]],"shading":{"on":false}}"#,
    },
    Scene {
        name: "two-walls",
        volume: "formula:two-walls:32",
        transfer: r#"{"version":1,"domain":"value","color_space":"linear",
            "colors":[[100,1,0,0],[101,0,0,1]],
            "opacities":[[99,0],[100,0.5],[101,0.5],[200,0.9]],"shading":{"on":false}}"#,
    },
    // Extinction and colour are linear in x.
    Scene {
        name: "ramp",
        volume: "formula:ramp:24",
        transfer: r#"{"version":1,"domain":"unit","color_space":"linear","opacity_unit":"extinction",
            "colors":[[0,0,0.2,1],[1,1,0.8,0]],"opacities":[[0,0],[1,0.5]],
            "shading":{"on":false}}"#,
    },
    // From faint and blue to nearly opaque and red, in one step of a linear field.
    Scene {
        name: "step",
        volume: "formula:ramp:24",
        transfer: r#"{"version":1,"domain":"unit","color_space":"linear",
            "colors":[[0.5,0.1,0.2,0.9],[0.5,0.9,0.4,0.1]],
            "opacities":[[0.5,0.05],[0.5,0.99]],"shading":{"on":false}}"#,
    },
    // A Gaussian whose colour changes towards its middle.
    Scene {
        name: "bell",
        volume: "formula:bell:32",
        transfer: r#"{"version":1,"domain":"value","color_space":"linear","opacity_unit":"extinction",
            "colors":[[0,0,0.2,1],[1,1,0.8,0]],"opacities":[[0,0],[1,0.8]],
            "shading":{"on":false}}"#,
    },
];
