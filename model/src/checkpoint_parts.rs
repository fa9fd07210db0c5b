//! Trunk and scene: taking a complete checkpoint apart and putting the parts together.
//!
//! A trunk (CNN1, RCNN1) knows motion and is shared; a scene (RCNN2, FCFL) knows one place and is swapped. A scene names
//! the content hash of its trunk and works with no other.

use std::collections::BTreeMap;

use crate::checkpoint::Checkpoint;
use crate::checkpoint_error::CheckpointError;
use crate::config::NetworkConfig;
use crate::metadata::{CheckpointMetadata, Heads, Kind, Provenance};
use crate::tensors::Tensors;

impl Checkpoint {
    /// Takes a complete checkpoint apart into its trunk and its scene.
    ///
    /// # Errors
    /// When it is not complete, or its network has no global branch and so no scene.
    pub fn split(self) -> Result<(Self, Self), CheckpointError> {
        let Self { metadata, tensors, origin } = self;
        if metadata.kind != Kind::Complete {
            let needed = "a complete one";
            return Err(CheckpointError::Kind { path: origin, found: metadata.kind, needed });
        }
        if !metadata.network.branches.global {
            let problem = "its network has no global branch, so it has no scene to split off".into();
            return Err(CheckpointError::Inconsistent { path: origin, problem });
        }
        let (trunk, scene): (Tensors, Tensors) =
            tensors.into_iter().partition(|(name, _)| Kind::Trunk.holds(name));
        let part = |kind, trunk_hash| CheckpointMetadata {
            kind,
            trunk_hash,
            heads: metadata.heads.of_kind(kind),
            ..metadata.clone()
        };
        // A trunk knows no place.
        let trunk_metadata = CheckpointMetadata {
            scene: None,
            map_from_world: None,
            motion_log_variance_shift: None,
            ..part(Kind::Trunk, None)
        };
        let trunk = Self::from_parts(trunk_metadata, trunk, origin.clone())?;
        let bound_to = Some(trunk.content_hash().to_owned());
        let scene = Self::from_parts(part(Kind::Scene, bound_to), scene, origin)?;
        Ok((trunk, scene))
    }

    /// Puts a trunk and a scene together into a complete checkpoint. A complete `trunk` gives its trunk; its own scene is
    /// dropped.
    ///
    /// # Errors
    /// When a file is of the wrong kind, the scene belongs to another trunk, or both disagree about the network or the
    /// preprocessing.
    pub fn merge(trunk: Self, scene: Self) -> Result<Self, CheckpointError> {
        if scene.metadata.kind != Kind::Scene {
            let needed = "a scene file";
            return Err(CheckpointError::Kind { path: scene.origin, found: scene.metadata.kind, needed });
        }
        let trunk = match trunk.metadata.kind {
            Kind::Trunk => trunk,
            Kind::Complete => trunk.split()?.0,
            found @ Kind::Scene => {
                let needed = "a trunk or a complete checkpoint";
                return Err(CheckpointError::Kind { path: trunk.origin, found, needed });
            }
        };
        if scene.metadata.trunk_hash.as_deref() != Some(trunk.content_hash()) {
            return Err(CheckpointError::TrunkMismatch {
                wanted: scene.metadata.trunk_hash.unwrap_or_default(),
                found: trunk.metadata.content_hash,
                scene: scene.origin,
                trunk: trunk.origin,
            });
        }
        if let Some(what) = difference(&trunk.metadata, &scene.metadata) {
            return Err(CheckpointError::PartsDiffer { scene: scene.origin, trunk: trunk.origin, what });
        }
        let metadata = CheckpointMetadata {
            kind: Kind::Complete,
            trunk_hash: None,
            heads: Heads { relative: trunk.metadata.heads.relative, ..scene.metadata.heads },
            provenance: joint_provenance(trunk.metadata.provenance, scene.metadata.provenance),
            camera: scene.metadata.camera.or(trunk.metadata.camera),
            ..scene.metadata
        };
        let mut tensors = trunk.tensors;
        tensors.extend(scene.tensors);
        Self::from_parts(metadata, tensors, scene.origin)
    }
}

/// What the two parts must agree on and do not.
fn difference(trunk: &CheckpointMetadata, scene: &CheckpointMetadata) -> Option<String> {
    // The trunk does not care about the parts that the scene adds.
    let shared = NetworkConfig {
        branches: crate::Branches {
            global: scene.network.branches.global,
            fusion: scene.network.branches.fusion,
            ..trunk.network.branches
        },
        fc2: scene.network.fc2,
        fc3: scene.network.fc3,
        ..trunk.network.clone()
    };
    if shared != scene.network {
        return Some(format!("the network: the scene has {:?}, the trunk {shared:?}", scene.network));
    }
    (trunk.preprocessing != scene.preprocessing).then(|| {
        format!(
            "the preprocessing: the scene has {:?}, the trunk {:?}",
            scene.preprocessing, trunk.preprocessing
        )
    })
}

/// One untrained part makes the whole untrained; two records stand side by side.
fn joint_provenance(trunk: Provenance, scene: Provenance) -> Provenance {
    match (trunk, scene) {
        (trunk, scene) if trunk == scene => trunk,
        (trunk @ Provenance::Untrained { .. }, _) => trunk,
        (_, scene @ Provenance::Untrained { .. }) => scene,
        (Provenance::Trained(trunk), Provenance::Trained(scene)) => {
            let object = |map: BTreeMap<_, _>| serde_json::Value::Object(map.into_iter().collect());
            let parts = [("trunk".to_owned(), object(trunk)), ("scene".to_owned(), object(scene))];
            Provenance::Trained(parts.into())
        }
    }
}
