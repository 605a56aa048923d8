//! Scenes of records of format 3, which hold their transfer function as JSON.
//!
//! All other fields have the numbers that `cluster.proto` still gives them. Number 3 is reserved
//! there for this.

use slabcast_common::message::SceneSpec;
use slabcast_common::transfer::TransferFunction;
use slabcast_proto::{cluster_v1 as wire, convert};

/// What format 3 has beside the fields of [`wire::Scene`].
#[derive(Clone, PartialEq, prost::Message)]
struct OldScene {
    #[prost(string, tag = "3")]
    transfer_json: String,
}

/// Reads a scene of any format.
///
/// # Errors
/// Says which field is wrong.
pub(super) fn scene(bytes: &[u8]) -> Result<SceneSpec, String> {
    use prost::Message;
    let mut scene = wire::Scene::decode(bytes).map_err(|e| format!("is no scene: {e}"))?;
    let old = OldScene::decode(bytes).map_err(|e| format!("is no scene: {e}"))?;
    let old = scene.transfer.is_none().then_some(old.transfer_json);
    if old.is_some() {
        // Any good one, so that all else is checked; the scene's own takes its place below.
        scene.transfer = Some(wire::TransferFunction {
            domain: wire::TransferDomain::Unit as i32,
            colors: vec![wire::ColorPoint::default()],
            opacities: vec![wire::OpacityPoint::default()],
            ..wire::TransferFunction::default()
        });
    }
    let mut scene = convert::scene_from_wire(scene).map_err(|e| e.to_string())?;
    if let Some(json) = old {
        let transfer = TransferFunction::from_json(&json);
        scene.transfer = transfer.map_err(|e| format!("transfer_json.{e}"))?;
    }
    Ok(scene)
}
