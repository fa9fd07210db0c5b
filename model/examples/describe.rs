//! Prints the layers of a preset: `cargo run -p grnet-model --example describe -- grnet`.

use std::io::Write as _;

use grnet_model::{LayerKind, NetworkConfig, PRESETS};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let Some(name) = std::env::args().nth(1) else {
        return Err(format!("usage: describe PRESET, one of {}", PRESETS.join(", ")).into());
    };
    let config = NetworkConfig::preset(&name)?;
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "{:<34} {:<28} {:<16} {:>11} {:>13}",
        "layer", "kind", "output", "parameters", "multiply-adds"
    )?;
    for layer in config.layers() {
        writeln!(
            out,
            "{:<34} {:<28} {:<16} {:>11} {:>13}",
            layer.name,
            kind(layer.kind),
            format!("{:?}", layer.output),
            layer.parameters(),
            layer.multiply_adds()
        )?;
    }
    writeln!(
        out,
        "{name}: {:.1} M parameters, {:.0} M multiply-adds per frame",
        config.parameter_count() as f64 / 1e6,
        config.multiply_adds_per_frame() as f64 / 1e6
    )?;
    Ok(())
}

fn kind(kind: LayerKind) -> String {
    match kind {
        LayerKind::Convolution { inputs, outputs, kernel, stride } => {
            format!("conv {kernel}x{kernel}/{stride} {inputs} -> {outputs}")
        }
        LayerKind::BatchNorm { channels } => format!("batch norm {channels}"),
        LayerKind::MaxPool => "max-pool 3x3/2".into(),
        LayerKind::AveragePool => "average pool".into(),
        LayerKind::Flatten => "flatten".into(),
        LayerKind::Lstm { layer, inputs, hidden } => format!("lstm {layer}: {inputs} -> {hidden}"),
        LayerKind::Linear { inputs, outputs } => format!("linear {inputs} -> {outputs}"),
    }
}
