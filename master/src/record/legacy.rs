//! Scenes of records of format 3, which hold their transfer function as JSON.
//!
//! All other fields have the numbers that `cluster.proto` still gives them. Number 3 is reserved
//! there for this.

use slabcast_common::message::SceneSpec;
use slabcast_common::transfer::TransferFunction;
use slabcast_proto::{cluster_v1 as wire, convert};

/// Fields of a scene in format 3 beside those of [`wire::Scene`].
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
    let mut scene = wire::Scene::decode(bytes).map_err(|e| format!("is not a scene: {e}"))?;
    let old = OldScene::decode(bytes).map_err(|e| format!("is not a scene: {e}"))?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message;
    use slabcast_common::brick::BrickSetKey;
    use slabcast_common::ids::SceneId;
    use slabcast_common::quality::{Quality, Sums};
    use slabcast_common::volume::{Digest32, Volume};
    use slabcast_scene::presets;

    #[test]
    fn scene_of_format_3_is_read_with_its_transfer_function_from_json() {
        let volume = Volume::from_fn_u8("cube", [8; 3], |i, j, k| (i + j + k) as u8);
        let spec = SceneSpec {
            id: SceneId(5),
            transfer: presets::by_name("peer-semi", &volume.summary).unwrap(),
            volume: volume.info(Digest32([7; 32])),
            quality: Quality { sums: Sums::I32, ..Quality::before() },
            crop: None,
            bricks: BrickSetKey(Digest32([9; 32])),
        };
        let new = convert::scene_to_wire(&spec);
        assert_eq!(scene(&new.encode_to_vec()), Ok(spec.clone()));
        let without = wire::Scene { transfer: None, ..new };
        let written = |transfer_json: String| {
            [without.encode_to_vec(), OldScene { transfer_json }.encode_to_vec()].concat()
        };
        assert_eq!(scene(&written(spec.transfer.to_json())), Ok(spec));
        let refused = scene(&written("{".into())).unwrap_err();
        assert!(refused.starts_with("transfer_json."), "{refused}");
    }
}
