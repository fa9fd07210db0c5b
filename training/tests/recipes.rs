//! The recipes that ship are recipes, and the network they ask for exists.

use std::path::Path;

use grnet_train::train::Recipe;

#[test]
fn every_recipe_is_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("recipes");
    let mut read = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        let (recipe, text) = Recipe::read(&path).unwrap_or_else(|error| {
            let source = std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default();
            panic!("{error}: {source}")
        });
        if let Some(network) = &recipe.network {
            let network = network.config().unwrap();
            for stage in &recipe.stages {
                stage.check_network(&network).unwrap();
            }
        }
        assert!(text.starts_with('#'), "{} says what it is for", path.display());
        read += 1;
    }
    assert!(read >= 8, "{read} recipes in {}", folder.display());
}

#[test]
fn the_guides_example_is_a_recipe() {
    let guide = include_str!("../../docs/training.md");
    let example = guide.split("```toml").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let recipe = Recipe::parse(example, Path::new("docs/training.md")).unwrap();
    assert_eq!(recipe.stages.len(), 3);
}
