//! One streamed frame through the network, without preprocessing: `cargo bench -p grnet-model --bench step`.

use criterion::{Criterion, criterion_group, criterion_main};
use grnet_model::candle_core::{Device, Tensor};
use grnet_model::{LoadedModel, NetworkConfig};

fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("step");
    group.sample_size(20);
    for preset in ["grnet", "grnet-small"] {
        let config = NetworkConfig::preset(preset).expect("a preset");
        let model = LoadedModel::untrained(&config, 1).expect("untrained weights");
        let (height, width) = (config.input_height_px, config.input_width_px);
        let values =
            (0..3 * height * width).map(|i| (i * 7919 % 2003) as f32 / 1001.0 - 1.0).collect::<Vec<_>>();
        let image = Tensor::from_vec(values, (1, 3, height, width), &Device::Cpu).expect("an image");
        let mut state = model.network.initial_state();
        group.bench_function(preset, |bencher| {
            bencher.iter(|| model.network.step(&image, &mut state).expect("a pose"));
        });
    }
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
